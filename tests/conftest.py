"""Shared settings of all tests: quiet Warp, devices, examples of Hypothesis."""

import gc
import os
import signal

import pytest
import warp as wp
from hypothesis import HealthCheck, settings

from dots import dots, scene_file  # noqa: F401  # fixtures of whatever runs scenes
from warp_lcp.rows.kernel_messages import start_warp

collect_ignore = ["emulated_cuda.py"]  # a plug-in that changes all later imports
wp.config.log_level = wp.LOG_ERROR
# Parallel test processes share the cores, as ranks do.
if workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    os.environ.setdefault("WARP_LCP_THREADS", str(max((os.cpu_count() or 1) // int(workers), 1)))
# Shells ignore both in background processes; tests send them.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)

UNHURRIED = {
    "deadline": None,
    "database": None,
    "suppress_health_check": [HealthCheck.too_slow, HealthCheck.data_too_large],
}
settings.register_profile("few", max_examples=100, derandomize=True, **UNHURRIED)
settings.register_profile(
    "fuzz", max_examples=int(os.environ.get("FUZZ_EXAMPLES", "10000")), **UNHURRIED
)
settings.load_profile("few")


def pytest_collection_modifyitems(items):
    # The longest first, so that others run beside it.
    items.sort(key=lambda item: item.name.startswith("test_kernels_compile_for_cuda"), reverse=True)
    start_warp()
    if not wp.is_cuda_available():
        skip = pytest.mark.skip(reason="no CUDA device on this machine")
        for item in items:
            if item.get_closest_marker("cuda"):  # not a keyword, since a folder may have that name
                item.add_marker(skip)


@pytest.fixture
def only_new_objects():
    """Exclude existing objects from garbage collection and counts of memory.

    A search of the objects of all other tests, which are millions, takes a second.
    """
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def device(request):
    return request.param
