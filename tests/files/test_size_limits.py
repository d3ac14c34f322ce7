"""Sizes that files claim: refused before anything is allocated, with both figures."""

import pytest

from fuzz.told import limited
from warp_lcp.files import size_limits as claims
from warp_lcp.files.size_limits import SizeLimitError, check_claim, free_host_memory


@pytest.fixture(autouse=True)
def gigabyte(monkeypatch):
    monkeypatch.setattr(claims, "free_host_memory", lambda: 10**9)


@pytest.mark.parametrize(
    ("needed", "stored", "held"),
    [(0, None, None), (10**9, None, None), (50, 50, 50), (10**9, 3, 50)],
)
def test_sizes_within_the_limits_are_accepted(needed, stored, held):
    check_claim("a", needed, stored=stored, available=held)


@pytest.mark.parametrize(
    ("needed", "stored", "held", "message"),
    [
        (-1, None, None, "n: a size must be >= 0"),
        (10**9 + 1, None, None, "n: these need 1 GB of memory, and 1 GB are free"),
        (10**400, None, None, "of memory, and 1 GB are free"),
        (50, 51, 50, "n: these take 51 bytes, and the file has 50 bytes"),
        (50, 2 * 10**18, 5 * 10**6, "n: these take 2e[+]09 GB, and the file has 5 MB"),
    ],
)
def test_sizes_beyond_the_limits_are_refused(needed, stored, held, message):
    with pytest.raises(SizeLimitError, match=message):
        check_claim("n", needed, stored=stored, available=held)


def test_without_free_memory_figures_the_total_memory_is_the_limit(monkeypatch):
    monkeypatch.setattr(claims, "free_host_memory", lambda: None)
    check_claim("n", 10**30)
    with pytest.raises(SizeLimitError, match="the file has 5 bytes"):
        check_claim("n", 6, stored=6, available=5)


def test_the_limit_of_the_process_counts():
    before = free_host_memory()
    with limited(2**28):
        free = free_host_memory()
    assert before is None or (free is not None and 2**27 < free <= 2**28 < before)
