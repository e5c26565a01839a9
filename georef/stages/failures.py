"""What becomes of an error in the computation of one image: a value, so that the run of all others goes on."""

from __future__ import annotations

import logging

from georef.errors import ConfigError, CrsError, WeightsError
from georef.types.results import RejectReason

_OF_THE_RUN = (MemoryError, OSError, ImportError, ConfigError, CrsError, WeightsError)
_OF_THE_DEVICE = {"OutOfMemoryError", "AcceleratorError"}  # of torch, which need not be loaded: kinds of RuntimeError
_OPENCV_NO_MEMORY = -4  # cv2.Error.StsNoMem
logger = logging.getLogger(__name__)


def internal_failure(error: Exception, what: str) -> tuple[str, str]:
    """The reason and detail of what went wrong with one item, logged with its traceback; what names work and item.

    For use in `except Exception`: an error that the other items would meet as well (no memory, a full disk, missing
    weights, a device that is lost) is raised again.
    """
    if _ends_the_run(error):
        raise error
    logger.error("%s failed", what, exc_info=error)
    return RejectReason.INTERNAL.value, f"{type(error).__name__}: {error}"


def _ends_the_run(error: Exception) -> bool:
    if isinstance(error, _OF_THE_RUN) or getattr(error, "code", None) == _OPENCV_NO_MEMORY:
        return True
    return any(kind.__name__ in _OF_THE_DEVICE for kind in type(error).__mro__)
