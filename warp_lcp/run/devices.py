"""Devices, engines and software versions of a run."""

from __future__ import annotations

import platform
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version

import warp as wp

from warp_lcp.files.size_limits import free_host_memory
from warp_lcp.kernels.log_filter import start_warp
from warp_lcp.run.kernel_cache import cache_error, watch_loads
from warp_lcp.simulation import InputError

# Default time that ranks wait for one of them [s]: compilation of kernels and the largest frames
# take less.
RANK_TIMEOUT = 600.0


class EngineError(InputError):
    """An engine cannot be used here.

    The message says why and what to do.
    """


class Engine(StrEnum):
    """Engine of a computation: this process, or MPI ranks started by `mpiexec`."""

    SINGLE = "single"  # one process with one device
    PETSC = "petsc"  # MPI ranks, with grids distributed by PETSc


class DeviceError(InputError):
    """There is no such device; the message lists the available ones."""


def devices() -> dict[str, str]:
    """Return the devices of this machine and their descriptions, preferred one first.

    Raises:
        KernelCacheError: the cache of compiled kernels cannot be used.
    """
    try:
        start_warp()
    except OSError as error:
        raise cache_error(error) from error
    watch_loads()
    found = [*wp.get_cuda_devices(), wp.get_device("cpu")]
    return {device.alias: _describe(device) for device in found}


def choose_device(name: str | None) -> str:
    """Return the device of this name; without a name, the preferred one.

    Raises:
        DeviceError: there is no such device.
    """
    available = devices()
    if name is None:
        return next(iter(available))
    alias = "cuda:0" if name == "cuda" else name
    if alias not in available:
        raise DeviceError(
            f"--device {name}: there is no such device; choose from {', '.join(available)}"
        )
    return alias


def free_memory(name: str) -> int | None:
    """Return the free memory of a device [bytes]; None if unknown."""
    device = wp.get_device(name)
    if device.is_cuda:
        return int(device.free_memory)
    return free_host_memory()


def cuda_driver() -> str:
    """Return the version of the CUDA driver, or a text if there is none."""
    devices()
    version = wp.get_cuda_driver_version()
    return "none found" if version is None else ".".join(map(str, version))


def _describe(device: wp.Device) -> str:
    if device.is_cuda:
        return (
            f"{device.name}, {device.total_memory / 2**30:.1f} GiB, compute capability "
            f"{device.arch / 10:.1f}"
        )
    return str(device.name)


def versions() -> dict[str, str]:
    """Return the versions of all software that affects the results."""
    found = {name: _version(name) for name in ("warp-lcp", "warp-lang", "numpy")}
    return {**found, "python": platform.python_version(), "platform": platform.platform()}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed as a distribution"
