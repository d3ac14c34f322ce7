"""Load balance of the ranks' boxes."""

import itertools
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from warp_lcp.distributed import balance
from warp_lcp.distributed.balance import WorkLoad, edge_of_blocks
from warp_lcp.distributed.decomposition import (
    OPEN,
    balanced_processes,
    cells_with_ghosts,
    parts,
    pool,
)

ALL = np.zeros(3), np.array([64.0, 32.0, 32.0])


def box(*high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a box of material from the origin on."""
    return np.zeros(3), np.array(high)


def test_a_column_is_cut_along_the_axis_that_it_stays_balanced_along():
    counts = (64, 32, 32)
    assert balanced_processes(
        counts, 2, layers=5, states=[[box(16, 20, 32)], [box(64, 5, 32)]]
    ) == (1, 1, 2)
    assert balanced_processes(counts, 2, layers=5, states=[[box(64, 32, 4)], [box(64, 4, 32)]]) == (
        2,
        1,
        1,
    )


def test_uniform_material_is_cut_with_the_fewest_ghost_cells():
    assert balanced_processes((64, 32, 32), 2, layers=5, states=[[ALL]]) == (2, 1, 1)
    assert balanced_processes((64, 64, 1), 4, layers=5, states=[[box(64, 64, 1)]]) == (2, 2, 1)


def test_no_box_is_thinner_than_the_ghost_layers():
    assert balanced_processes((64, 32, 9), 2, layers=5, states=[[box(8, 32, 9)]]) == (1, 2, 1)
    assert balanced_processes((16, 8, 8), 8, layers=5, states=[[box(16, 8, 8)]]) is None


@pytest.mark.parametrize(
    ("gravity", "low", "high"),
    [
        ([0.0, -9.81, 0.0], [0, 0, 0], [64, 8, 32]),
        ([1.0, 9.81, 0.0], [0, 24, 0], [64, 32, 32]),
        ([-9.81, 2.0, 0.0], [0, 0, 0], [16, 32, 32]),
        ([0.0, 0.0, 0.0], [0, 0, 0], [64, 32, 32]),
    ],
)
def test_material_comes_to_rest_where_gravity_points(gravity, low, high):
    found = pool((64, 32, 32), 3, 16.0 * 32 * 32, np.array(gravity))
    np.testing.assert_allclose(found, [low, high])


@pytest.mark.parametrize(("resolution", "ranks"), [(1588, 60), (3420, 600), (7368, 6000)])
def test_the_page_of_large_runs_has_the_boxes_of_the_dam(resolution, ranks):
    counts = (resolution, resolution // 2, resolution // 2)
    dam = np.zeros(3), np.array(counts) * (0.25, 0.625, 1.0)
    rest = pool(counts, 3, float(np.prod(dam[1])), np.array([0.0, -9.81, 0.0]))
    processes = balanced_processes(counts, ranks, layers=5, states=[[dam], [rest]])
    largest = " x ".join(str(max(parts(n, p))) for n, p in zip(counts, processes, strict=True))
    page = (Path(__file__).parents[2] / "docs" / "planning.md").read_text()
    assert f"| {ranks} | {largest} |" in page


def busiest(load, cut):
    """Return the load of the busiest rank, by a sum over its blocks."""
    ends = [[0, *-(-np.cumsum(part) // load.edge)] for part in cut]
    boxes = itertools.product(*(list(itertools.pairwise(end)) for end in ends))
    full = [load.material[tuple(slice(a, b) for a, b in box)].sum() for box in boxes]
    return (np.array(full) + OPEN * cells_with_ghosts(load.counts, cut, load.layers).ravel()).max()


@pytest.mark.parametrize(("least", "pays"), [(560.0, True), (780.0, False)])
def test_boxes_are_repartitioned_only_if_the_step_gets_a_quarter_shorter(least, pays, monkeypatch):
    """Repartition only if the whole step becomes shorter by a quarter.

    The rest of a step, as much as all work of the busiest rank, does not become shorter: 2000 is
    1.28 times 1560 and 1.12 times 1780.
    """
    cuts = [[3, 5], [8], [8]]
    now = SimpleNamespace(counts=(8, 8, 8), parts=[[4, 4], [8], [8]], repartition=lambda cut: cut)
    ranks = SimpleNamespace(size=2, rank=0, collect=lambda mine: [mine, None])
    part = SimpleNamespace(decomposition=now, layers=3, ranks=ranks)
    particles = SimpleNamespace(exchange=SimpleNamespace(counts=[1000, 100]))
    monkeypatch.setattr(
        balance, "cells_with_ghosts", lambda counts, parts, layers: np.zeros((2, 1, 1))
    )
    monkeypatch.setattr(balance, "blocks", lambda part, particles, edge: np.zeros(1))
    monkeypatch.setattr(
        balance, "WorkLoad", lambda *given: SimpleNamespace(best=lambda *asked, rank: (least, cuts))
    )
    found = balance.Balance(fixed=1000.0).rebalance(part, particles, 1)
    assert found == (cuts if pays else None)


def every_cut(blocks, p, least):
    """Yield all cuts of blocks into p parts of at least `least` blocks."""
    for inner in itertools.combinations(range(1, blocks), p - 1):
        sizes = np.diff([0, *inner, blocks])
        if p == 1 or sizes.min() >= least:
            yield sizes.tolist()


@pytest.mark.parametrize("draw", range(6))
def test_cuts_by_load_leave_the_busiest_rank_as_little_as_any_cuts_along_one_axis(draw):
    drawn = np.random.default_rng(7300 + draw)
    counts = tuple(int(n) for n in drawn.integers(9, 17, 3))
    load = WorkLoad(counts, 3, 1, drawn.random(counts) ** 8 * 40.0)
    ranks = int(drawn.integers(2, 4))
    work, cut = load.best(ranks)
    assert work == pytest.approx(busiest(load, cut), rel=1e-12)
    assert [sum(part) for part in cut] == list(counts)
    for axis, p in itertools.product(range(3), [ranks]):
        for part in every_cut(counts[axis], p, 3):
            assert work <= busiest(
                load, [part if a == axis else [n] for a, n in enumerate(counts)]
            ) * (1.0 + 1e-12)


def test_cuts_by_load_lie_between_blocks_that_multigrid_gathers():
    counts = (100, 90, 61)
    material = np.zeros([math.ceil(n / 4) for n in counts])
    material[:5, :, :3] = 64.0
    load = WorkLoad(counts, 5, edge_of_blocks(counts, 8), material)
    assert load.edge == 4
    work, cut = load.best(8)
    assert all(m % 4 == 0 for part in cut for m in part[:-1])
    assert work == pytest.approx(busiest(load, cut))
    assert work < 0.7 * busiest(load, [[parts(n, 2)[0], n - parts(n, 2)[0]] for n in counts])
    assert load.best(8, cut)[0] == work
    assert WorkLoad((16, 8, 8), 5, 1, np.ones((16, 8, 8))).best(8) is None
