"""Grid problems on ranks: solutions, statuses and counts of one process."""

from pathlib import Path

import numpy as np
import pytest

from warp_lcp.distributed.decomposition import CellBox, parts

PROGRAMS = Path(__file__).parent


@pytest.mark.parametrize(
    "ranks", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 3, 4)), 2]
)
def test_problems_of_one_process_and_of_ranks(mpi, ranks):
    done = mpi(ranks, PROGRAMS / "grid_problems_on_ranks.py")
    assert sorted(done.stdout.split("\n"))[1:] == [
        f"rank {rank} of {ranks} is done" for rank in range(ranks)
    ]


@pytest.mark.parametrize(
    ("n", "p", "expected"),
    [(128, 2, [64, 64]), (129, 2, [64, 65]), (100, 3, [32, 32, 36]), (5, 5, [1] * 5)],
)
def test_cuts_lie_at_powers_of_two(n, p, expected):
    assert parts(n, p) == expected


def test_parts_cover_all_cells_about_evenly():
    for n in range(1, 200):
        for p in range(1, min(n, 9) + 1):
            found = parts(n, p)
            assert sum(found) == n
            assert min(found) >= 1
            assert max(found) <= np.ceil(1.125 * np.ceil(n / p))


def test_boxes():
    box = CellBox((0, 2, 4), (3, 5, 9))
    assert box.counts == (3, 3, 5)
    assert box.cells == 45
    assert box.grown(1) == CellBox((-1, 1, 3), (4, 6, 10))
    assert box.common(CellBox((2, 0, 0), (9, 9, 5))) == CellBox((2, 2, 4), (3, 5, 5))
    assert box.common(CellBox((3, 0, 0), (9, 9, 9))).cells == 0
    assert np.zeros((9, 5, 3))[box.slices].shape == (5, 3, 3)
