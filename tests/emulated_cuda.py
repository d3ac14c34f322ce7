"""Pytest plug-in that runs tests in CUDA's form on the CPU.

See `benchmarks/emulated_cuda.py`. `make emulated-cuda`, or

    PYTHONPATH=tests:. ORDER=permuted python -m pytest -p emulated_cuda tests/solvers

Tests of CPU-only behavior (`cpu_form`) are left out. With COMPARE=1 a test fails if it launched a
kernel whose results depend on the order of threads, except known kernels. With CELLS=1 it also
fails if a pass by quads of cells has other results than by cells.
"""

import pytest

from benchmarks.emulated_cuda import differs, otherwise


def pytest_collection_modifyitems(items):
    """Leave out tests of CPU-only behavior."""
    for item in items:
        if marked := item.get_closest_marker("cpu_form"):
            item.add_marker(pytest.mark.skip(reason=marked.args[0]))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Fail a test whose kernels depend on the thread order or on cells per thread."""
    differs.clear()
    otherwise.clear()
    result = yield
    if differs:
        pytest.fail(f"results depend on the order of threads: {', '.join(sorted(differs))}")
    if wrong := sorted(+otherwise):
        pytest.fail(f"otherwise by cells: {', '.join(wrong)}")
    return result
