"""What a run ran on: the versions that its record keeps."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version


def versions() -> dict[str, str]:
    """Return the versions of what decides a run's numbers."""
    found = {name: _version(name) for name in ("warp-lcp", "warp-lang", "numpy")}
    return {**found, "python": platform.python_version(), "platform": platform.platform()}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed as a distribution"
