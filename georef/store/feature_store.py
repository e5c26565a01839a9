"""Local features on disk: one safetensors file an image, complete or absent, for many processes at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from georef.errors import StageError
from georef.replacing import replacing
from georef.store.feature_encoding import EXACT, QUANTIZED, decode, encode
from georef.types.features import Features

_FORMAT = "georef.features.2"
_SUFFIX = ".safetensors"
_LONGEST_NAME = 240  # bytes; file systems end at 255


class FeatureStore:
    """Features of many images in one folder.

    extractor_version: what `Extractor.version()` says, written with every image; a stored image of another version
    counts as missing. None takes any version. Writers in different processes do not disturb each other: a file is
    written under a temporary name and then put in place as a whole.

    quantize: descriptors of real numbers are kept in seven bits a value, and scores in float16; the cosine between a
    descriptor and what is read back is 1 - 1e-4, its length is kept, keypoints, scales, orientations and colours are
    exact. Features come back in the types that they had. 1,024 of them with 128 values, one scale and no orientations
    take 133 KB. False keeps everything exactly. Where a version is given, images stored the other way count as missing;
    without one, both are read.
    """

    def __init__(self, folder: Path, *, extractor_version: str | None = None, quantize: bool = True) -> None:
        self._folder = folder
        self._version = extractor_version
        self._quantize = quantize

    def write(self, image_id: str, features: Features, source: Path) -> None:
        """Store the features of an image, and the size and time of the image file that they came from.

        Raises StageError for an image id too long to be a file name, ValueError for descriptors that are not finite,
        OSError where the disk refuses.
        """
        path = self._path(image_id)
        arrays, header = encode(features, self._quantize)
        with replacing(path) as temporary:
            save_file(arrays, temporary, metadata=self._metadata(image_id, features, source) | header)

    def has(self, image_id: str, source: Path | None = None) -> bool:
        """Whether usable features of this image are stored.

        False for a file that is missing or damaged, or of another extractor version, and, where `source` is given, for
        features that came from another state of that image file (size or time of change differ).
        """
        try:
            with self._open(image_id) as stored:
                metadata = stored.metadata()
        except StageError:
            return False
        return source is None or all(metadata.get(key) == value for key, value in _source_state(source).items())

    def read(self, image_id: str, max_keypoints: int | None = None) -> Features:
        """The features of an image, or the `max_keypoints` best of them; only their rows are read.

        Raises StageError, saying what to run, for features that are missing, damaged or of another version.
        """
        with self._open(image_id) as stored:
            arrays = {name: partial(_head, stored, name) for name in stored.keys()}  # noqa: SIM118 (not a dict)
            return decode(arrays, stored.metadata(), max_keypoints)

    def ids(self) -> list[str]:
        """Ids of all stored images, sorted; files are not opened."""
        return sorted(unquote(path.name.removesuffix(_SUFFIX)) for path in self._folder.glob(f"*{_SUFFIX}"))

    def _path(self, image_id: str) -> Path:
        name = quote(image_id, safe="") + _SUFFIX  # letters, digits and _.-~ stay as they are, the rest becomes %XX
        if not image_id or len(name) > _LONGEST_NAME:
            raise StageError(
                f"The image id '{image_id[:80]}' cannot be a file name: it takes {len(name)} characters.\n"
                f"Expected 1 to {_LONGEST_NAME} once '/' and the like are written as %XX.\nGive the image a shorter id."
            )
        return self._folder / name

    def _metadata(self, image_id: str, features: Features, source: Path) -> dict[str, str]:
        width, height = features.image_size
        return {
            "format": _FORMAT,
            "image_id": image_id,
            "image_width": str(width),
            "image_height": str(height),
            "extractor_version": self._version or "",
            **_source_state(source),
        }

    @contextmanager
    def _open(self, image_id: str) -> Iterator[Any]:
        path = self._path(image_id)
        remedy = f"Run the extraction again; it computes what is missing.\nIn {path}"
        if not path.is_file():
            raise StageError(f"There are no features of image '{image_id}'.\n{remedy}")
        try:
            with safe_open(path, framework="numpy") as stored:
                problem = self._problem(image_id, stored.metadata() or {})
                if problem:
                    raise StageError(f"The features of image '{image_id}' cannot be used: {problem}.\n{remedy}")
                yield stored
        except (SafetensorError, OSError) as error:
            raise StageError(f"The features of image '{image_id}' are damaged: {error}.\n{remedy}") from error

    def _problem(self, image_id: str, metadata: dict[str, str]) -> str:
        if metadata.get("format") != _FORMAT:
            return f"their format is '{metadata.get('format', 'none')}', expected '{_FORMAT}'"
        if metadata.get("image_id") != image_id:  # a file system that does not tell A from a
            return f"the file holds image '{metadata.get('image_id')}'"
        version = metadata.get("extractor_version")
        if self._version is not None and version != self._version:
            return f"their extractor was '{version}', expected '{self._version}'"
        encoding, expected = metadata.get("encoding"), QUANTIZED if self._quantize else EXACT
        if self._version is not None and encoding != expected:
            return f"they are stored as '{encoding}', expected '{expected}'"
        return ""


def _head(stored: Any, name: str, count: int | None) -> np.ndarray:
    rows = stored.get_slice(name)
    if count is None or count >= rows.get_shape()[0]:  # safetensors cuts only inside
        return stored.get_tensor(name)
    return rows[:count]


def _source_state(source: Path) -> dict[str, str]:
    try:
        status = source.stat()
    except FileNotFoundError:
        return {"source_size": "missing", "source_mtime_ns": "missing"}
    return {"source_size": str(status.st_size), "source_mtime_ns": str(status.st_mtime_ns)}
