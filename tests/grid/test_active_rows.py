"""Active row segments, the cells that particles reach, against NumPy and SciPy."""

import numpy as np
import pytest
import scipy.ndimage
import warp as wp

from warp_lcp.grid import active_rows as module
from warp_lcp.grid.active_rows import ActiveRows, spread
from warp_lcp.grid.cell_kernel import F32, cell_kernel
from warp_lcp.grid.level_set_kernels import BINOMIAL
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import COPY, SEGMENT, DirtyRegion, StaggeredGrid, Window, pieces_of

GRID = StaggeredGrid((37, 20, 12), 0.1, 3, "cpu")
PLANE = StaggeredGrid((61, 40, 1), 0.1, 2, "cpu")


@cell_kernel("tests.vicinity")
def count_kernel(k, j, i, out: F32):  # type: ignore[no-untyped-def]
    """Count visits of a cell."""
    out[k, j, i] = out[k, j, i] + 1.0


@cell_kernel("tests.vicinity")
def visit_rows_kernel(k, j, first, end, out: F32):  # type: ignore[no-untyped-def]
    """Write the begin and the end of a row's cells."""
    out[k, j, 0] = float(first)
    out[k, j, 1] = float(end)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip cells in small boxes too, and in boxes where almost none can be skipped."""
    monkeypatch.setattr(module, "LEAST_CELLS", 0)
    monkeypatch.setattr(module, "MOST", 1.0)


def marked(grid: StaggeredGrid, near: np.ndarray, box: Window) -> np.ndarray:
    """Return which cells of a box are marked."""
    cells = np.repeat(near, SEGMENT, axis=2)[..., : grid.shape[2]] > 0
    inside = np.zeros(grid.shape, dtype=bool)
    inside[tuple(map(slice, box.low, box.high))] = True
    return cells & inside


def random_part(seed: int, share: float) -> Window:
    near = (
        np.random.default_rng(seed).random((*GRID.shape[:2], -(-GRID.shape[2] // SEGMENT))) < share
    )
    return Window((1, 3, 2), (12, 22, 37), GRID.device, near.astype(np.uint8))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_each_marked_cell_of_a_box_is_visited_once_and_no_other(share: float) -> None:
    for seed in range(4):
        part, out, rows = random_part(seed, share), GRID.field(), GRID.field()
        assert part.near is not None
        part.launch(count_kernel, [out])
        expected = marked(GRID, part.near, part)
        np.testing.assert_array_equal(out.numpy(), expected)
        source, smooth, whole = (
            wp.array(
                np.random.default_rng(seed).random(GRID.shape), dtype=wp.float32, device="cpu"
            ),
            GRID.field(),
            GRID.field(),
        )
        inner = Window((1, 3, 2), (12, 21, 37), GRID.device)
        inner.run(BINOMIAL, planes=2, source=source, out=whole)
        part.common(inner).run(BINOMIAL, planes=2, source=source, out=smooth)  # type: ignore[union-attr]
        np.testing.assert_array_equal(
            smooth.numpy(), np.where(marked(GRID, part.near, inner), whole.numpy(), 0.0)
        )
        part.launch_rows(visit_rows_kernel, [rows])
        used = expected.any(axis=2)
        first, last = expected.argmax(axis=2), GRID.shape[2] - expected[..., ::-1].argmax(axis=2)
        np.testing.assert_array_equal(rows.numpy()[..., 0], np.where(used, first, 0))
        np.testing.assert_array_equal(rows.numpy()[..., 1], np.where(used, last, 0))
        sums = wp.array(np.ones((*GRID.shape[:2], 2)), dtype=wp.float64, device="cpu")
        seen = part.near[1:12, 3:22].any(axis=2)
        np.testing.assert_array_equal(part.rows_of(sums), np.repeat(seen[..., None], 2, axis=2))


@pytest.mark.parametrize("cells", [0, 1, 3, 7])
def test_marks_spread_as_far_as_asked(cells: int) -> None:
    marks = (np.random.default_rng(1).random((9, 14, 11)) < 0.02).astype(np.uint8)
    for axis in range(3):
        expected = scipy.ndimage.maximum_filter1d(marks, 2 * cells + 1, axis=axis, mode="constant")
        np.testing.assert_array_equal(spread(marks, cells, axis), expected)


@pytest.mark.cpu_form("pieces of rows are the CPU's")
@pytest.mark.parametrize("grid", [GRID, PLANE])
def test_all_cells_that_particles_reach_are_near(grid: StaggeredGrid, small: None) -> None:
    """Near cells: all cells that particles reach.

    Now and in the step before, however often a step is repeated; along x to the end of a segment.
    """
    random, grow = np.random.default_rng(3), 4
    looked, box = ActiveRows(grid), grid.everywhere
    reached = []
    for step in (0, 1, 1, 2):
        position = random.random((6, 3)) * grid.extent * [1, 1, grid.dimension == 3]
        particles = Particles(grid, position, np.zeros((6, 3)), affine=False)
        cells = np.zeros(grid.shape, dtype=bool)
        i, j, k = (np.floor(position / grid.spacing).astype(int) + 1).T
        cells[k if grid.dimension == 3 else 1, j, i] = True
        sizes = (2 * grow + 1 if grid.dimension == 3 else 1, 2 * grow + 1, 2 * grow + 1)
        reached.append((step, scipy.ndimage.maximum_filter(cells, sizes, mode="constant")))
        window = looked.window(box, particles, grow, step)
        if step == 0:
            assert window.near is None, "what the step before reached is not known"
            continue
        assert window.near is not None
        expected = np.any([cells for at, cells in reached if at in (step - 1, step)], axis=0)
        found = marked(grid, window.near, box)
        assert not (expected & ~found).any()
        wide = scipy.ndimage.maximum_filter1d(expected, 4 * SEGMENT + 1, axis=2, mode="constant")
        assert not (found & ~wide).any()


@pytest.mark.cpu_form("pieces of rows are the CPU's")
def test_marks_are_kept_when_the_window_moves(small: None) -> None:
    old, new = (
        StaggeredGrid((32, 20, 12), 0.1, 3, "cpu", origin=at, whole=(80, 60, 40))
        for at in ((16, 8, 8), (24, 0, 16))
    )
    particles = Particles(old, np.array([[2.75, 1.25, 1.85]]), np.zeros((1, 3)), affine=False)
    before = ActiveRows(old)
    before.window(old.everywhere, particles, 2, 5)
    after = ActiveRows(new, before)
    particles.move_to(new)
    window = after.window(new.everywhere, particles, 2, 6)
    assert window.near is not None
    found = marked(new, window.near, new.everywhere)
    assert found[18 - 16 + 1 - 2 : 18 - 16 + 1 + 3, 12 + 1 - 2 : 12 + 1 + 3, 27 - 24 + 1].all()
    assert found.sum() <= 5 * 5 * 3 * SEGMENT


def test_trails_hold_the_parts_of_the_last_two_windows() -> None:
    one, two = random_part(1, 0.1), random_part(2, 0.1)
    trail = DirtyRegion(GRID.everywhere)
    assert trail.through(one).near is None
    both = trail.through(two)
    assert one.near is not None and two.near is not None and both.near is not None
    np.testing.assert_array_equal(both.near, one.near | two.near)
    assert trail.through(None).near is None


def test_runs_end_with_their_row() -> None:
    near = np.zeros((2, 2, 3), dtype=np.uint8)
    near[0, 0, 1:] = near[0, 1, 0] = near[1, 1] = 1
    runs = [[[0, 0], [8, 20]], [[0, 1], [0, 8]], [[1, 1], [0, 20]]]
    assert pieces_of(near, (0, 0, 0), (2, 2, 20)).tolist() == runs
    assert pieces_of(near, (1, 0, 3), (2, 2, 9)).tolist() == [[[1, 1], [3, 9]]]


def test_a_copy_of_a_box_writes_its_cells_only() -> None:
    low, high = (1, 3, 2), (4, 9, 20)
    source = np.random.default_rng(11).random(GRID.shape, dtype=np.float32)
    field = GRID.field()
    Window(low, high, GRID.device).run(
        COPY, source=wp.array(source, dtype=wp.float32, device="cpu"), field=field
    )
    expected = np.zeros(GRID.shape, np.float32)
    box = tuple(map(slice, low, high))
    expected[box] = source[box]
    np.testing.assert_array_equal(field.numpy(), expected)
