"""What a run ran on: the versions that its record keeps."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, distributions, entry_points, version

from warp_lcp.simulation import GROUP


def versions() -> dict[str, str]:
    """Return the versions of what decides a run's numbers."""
    found = {name: _version(name) for name in ("warp-lcp", "warp-lang", "numpy")}
    return {**found, "python": platform.python_version(), "platform": platform.platform()}


def shadowing_distributions() -> list[str]:
    """Return other distributions that are named like the package of a simulator, such as PyPI's `fluids`, and so install one too."""
    packages = {entry.module.partition(".")[0] for entry in entry_points(group=GROUP)}
    return sorted({f"{found.name} {found.version}" for found in distributions() if found.name.lower().replace("-", "_") in packages})


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed as a distribution"
