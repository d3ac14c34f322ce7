"""Pytest plugin: tests in CUDA's form on the CPU, see `benchmarks/emulated_cuda.py`. `make emulated-cuda`, or

    PYTHONPATH=tests:. ORDER=permuted python -m pytest -p emulated_cuda tests/solvers

Tests of the CPU's own ways (`cpu_form`) are left out. With COMPARE=1 a kernel whose results depend
on the order of threads, and that is not known to, fails the test that launched it. With CELLS=1 so
does a pass by quads of cells that finds something else than it does by cells.
"""

import pytest

from benchmarks.emulated_cuda import differs, otherwise


def pytest_collection_modifyitems(items):
    """Leave out what is not done on CUDA."""
    for item in items:
        if marked := item.get_closest_marker("cpu_form"):
            item.add_marker(pytest.mark.skip(reason=marked.args[0]))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Fail a test that launched a kernel whose results depend on the order of threads, or on how many cells a thread takes."""
    differs.clear()
    otherwise.clear()
    result = yield
    if differs:
        pytest.fail(f"results depend on the order of threads: {', '.join(sorted(differs))}")
    if wrong := sorted(+otherwise):
        pytest.fail(f"otherwise by cells: {', '.join(wrong)}")
    return result
