"""Shared settings of all tests: quiet Warp, devices, examples of Hypothesis."""

import gc
import os
import signal
import sys

import pytest
import warp as wp
from hypothesis import HealthCheck, settings

from default_run import mark_repeated_cases
from dots import dots, scene_file  # noqa: F401  # fixtures of whatever runs scenes
from warp_lcp.kernels.log_filter import start_warp

collect_ignore = ["emulated_cuda.py"]  # a plug-in that changes all later imports
wp.config.log_level = wp.LOG_ERROR
# Parallel test processes share the cores, as ranks do.
if workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    os.environ.setdefault("WARP_LCP_THREADS", str(max((os.cpu_count() or 1) // int(workers), 1)))
# Shells ignore both in background processes; tests send them.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)

start_warp()
DEVICES = ["cpu", *(["cuda:0"] if wp.is_cuda_available() else [])]

UNHURRIED = {
    "deadline": None,
    "database": None,
    "suppress_health_check": [HealthCheck.too_slow, HealthCheck.data_too_large],
}
settings.register_profile("few", max_examples=20, derandomize=True, **UNHURRIED)
settings.register_profile(
    "fuzz", max_examples=int(os.environ.get("FUZZ_EXAMPLES", "10000")), **UNHURRIED
)
settings.load_profile("few")


gc.disable()  # until tests are collected: of what that makes, nothing is garbage


def pytest_collection_finish():
    """Freeze the garbage collector's objects after collection.

    A million objects are imported and collected by then: each full garbage collection would take a
    second.
    """
    if "emulated_cuda" not in sys.modules:  # which finds kernels among all objects
        gc.freeze()
    gc.set_threshold(2000, 10, 10)  # three times the usual: a test leaves little
    gc.enable()


@pytest.hookimpl(tryfirst=True)  # before pytest leaves out the slow ones
def pytest_collection_modifyitems(items):
    mark_repeated_cases(items)
    # The longest first, so that others run beside it.
    items.sort(key=lambda item: item.name.startswith("test_kernels_compile_for_cuda"), reverse=True)
    if len(DEVICES) == 1:
        skip = pytest.mark.skip(reason="no CUDA device on this machine")
        for item in items:
            if item.get_closest_marker("cuda"):  # not a keyword, since a folder may have that name
                item.add_marker(skip)


@pytest.fixture
def only_new_objects():
    """Exclude existing objects from garbage collection and counts of memory."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def every_object():
    """Include what has been imported in searches of all objects."""
    gc.unfreeze()
    yield
    gc.freeze()


@pytest.fixture(params=DEVICES)
def device(request):
    """Each device of this machine that tests run on."""
    return request.param


@pytest.fixture
def pyvista():
    """VTK, which draws and reads files back; its tests are skipped where it is missing."""
    return pytest.importorskip("pyvista", reason="needs pyvista, the extra `render`")
