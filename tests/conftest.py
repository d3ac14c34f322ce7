"""Shared by all tests: quiet Warp, devices."""

import pytest
import warp as wp

wp.config.log_level = wp.LOG_ERROR


def pytest_collection_modifyitems(items):
    if not wp.is_cuda_available():
        skip = pytest.mark.skip(reason="no CUDA device on this machine")
        for item in items:
            if "cuda" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def device(request):
    return request.param
