"""How grids are cut so that ranks have about as much to do."""

from pathlib import Path

import numpy as np
import pytest

from warp_lcp.distributed.decomposition import balanced_processes, parts, pool

ALL = np.zeros(3), np.array([64.0, 32.0, 32.0])


def box(*high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a box of material from the origin on."""
    return np.zeros(3), np.array(high)


def test_a_column_is_cut_along_the_axis_that_it_stays_balanced_along():
    counts = (64, 32, 32)
    assert balanced_processes(counts, 2, layers=5, states=[[box(16, 20, 32)], [box(64, 5, 32)]]) == (1, 1, 2)
    assert balanced_processes(counts, 2, layers=5, states=[[box(64, 32, 4)], [box(64, 4, 32)]]) == (2, 1, 1)


def test_material_everywhere_is_cut_where_least_is_seen_by_others():
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
