"""Grid problems that ranks share have the solutions, the statuses and the counts of one process."""

from pathlib import Path

import numpy as np
import pytest

from warp_lcp.distributed.decomposition import Box, parts

PROGRAMS = Path(__file__).parent


@pytest.mark.parametrize("ranks", [1, 2, 3, 4])
def test_problems_of_one_process_and_of_ranks(mpi, ranks):
    done = mpi(ranks, PROGRAMS / "grid_problems_on_ranks.py")
    assert sorted(done.stdout.split("\n"))[1:] == [f"rank {rank} of {ranks} is done" for rank in range(ranks)]


@pytest.mark.parametrize("ranks", [2, 4])
def test_halos_of_every_type(mpi, ranks):
    assert (
        mpi(
            ranks,
            """
        import numpy as np
        from warp_lcp.distributed.decomposition import Decomposition
        from warp_lcp.distributed.halo import Halo
        from warp_lcp.distributed.ranks import Ranks

        ranks = Ranks.world()
        for counts in ((13, 11, 9), (40, 30, 1)):
            for width in (1, 3):
                boxes = Decomposition(counts, ranks)
                halo = Halo(boxes, width)
                for dtype in (np.int8, np.int16, np.float32, np.float64):
                    around = boxes.box.grown(width)
                    z, y, x = np.meshgrid(*(np.arange(l, h) for l, h in zip(around.low[::-1], around.high[::-1])), indexing="ij")
                    inside = (x >= 0) & (x < counts[0]) & (y >= 0) & (y < counts[1]) & (z >= 0) & (z < counts[2])
                    everyone = np.where(inside, ((z * 7 + y) * 5 + x) % 101, 0).astype(dtype)
                    field, inner = np.zeros(halo.shape, dtype), (slice(width, -width),) * 3
                    field[inner] = everyone[inner]
                    halo.fill(field)
                    assert (field == everyone).all()
        try:
            Halo(Decomposition((8, 8, 2 * ranks.size), ranks, processes=(1, 1, ranks.size)), 3)
            raise AssertionError("a halo wider than a box")
        except ValueError as error:
            assert "2 cells along z, but 3 ghost cells" in str(error)
        """,
        ).returncode
        == 0
    )


@pytest.mark.parametrize(("n", "p", "expected"), [(128, 2, [64, 64]), (129, 2, [64, 65]), (100, 3, [32, 32, 36]), (5, 5, [1] * 5)])
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
    box = Box((0, 2, 4), (3, 5, 9))
    assert box.counts == (3, 3, 5)
    assert box.cells == 45
    assert box.grown(1) == Box((-1, 1, 3), (4, 6, 10))
    assert box.common(Box((2, 0, 0), (9, 9, 5))) == Box((2, 2, 4), (3, 5, 5))
    assert box.common(Box((3, 0, 0), (9, 9, 9))).cells == 0
    assert np.zeros((9, 5, 3))[box.slices].shape == (5, 3, 3)
