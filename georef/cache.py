"""Where things that can be made or fetched again are kept between runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cache_folder(kind: str) -> Path:
    """Folder of one kind of things: `$GEOREF_CACHE/<kind>`, or in the platform's cache folder for this user."""
    configured = os.environ.get("GEOREF_CACHE")
    if configured:
        return Path(configured).expanduser() / kind
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "georef" / kind
