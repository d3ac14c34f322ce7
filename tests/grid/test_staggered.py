import numpy as np
import pytest
import warp as wp

from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window, cell_index


def test_shapes_in_2d_and_3d() -> None:
    flat = StaggeredGrid((5, 3, 1), 0.1, 2)
    solid = StaggeredGrid((5, 3, 4), 0.1, 3)
    assert flat.shape == (3, 5, 7)
    assert solid.shape == (6, 5, 7)
    assert [len(grid.faces()) for grid in (flat, solid)] == [2, 3]
    assert flat.cell_volume == pytest.approx(0.01)
    assert solid.cell_volume == pytest.approx(0.001)
    assert flat.field(wp.int8).dtype is wp.int8


@pytest.mark.parametrize(
    ("counts", "spacing", "dimension", "word"),
    [
        ((0, 3, 1), 0.1, 2, "counts"),
        ((3, 3, 2), 0.1, 2, "counts"),
        ((3, 3, 3), 0.0, 3, "spacing"),
        ((3, 3, 3), float("nan"), 3, "spacing"),
        ((3, 3, 3), 0.1, 4, "dimension"),
    ],
)
def test_bad_grids_are_refused(
    counts: tuple[int, int, int], spacing: float, dimension: int, word: str
) -> None:
    with pytest.raises(ValueError, match=word):
        StaggeredGrid(counts, spacing, dimension)


def test_coordinates_go_to_the_grid_and_back() -> None:
    grid = StaggeredGrid((5, 3, 4), 0.25, 3)
    points = np.random.default_rng(812).random((20, 3))
    assert grid.to_grid(np.zeros((1, 3))) == pytest.approx(1.0)
    assert grid.to_world(grid.to_grid(points)) == pytest.approx(points)


def test_windows_are_clipped_to_what_is_stored() -> None:
    flat = StaggeredGrid((5, 3, 1), 0.1, 2)
    assert (flat.everywhere.low, flat.everywhere.high) == ((1, 0, 0), (2, 5, 7))
    assert (flat.domain.low, flat.domain.high) == ((1, 1, 1), (2, 4, 6))
    solid = StaggeredGrid((5, 3, 4), 0.1, 3)
    window = solid.window((2, 1, 3), (2, 2, 3), grow=2)
    assert (window.low, window.high) == ((1, 0, 0), (6, 5, 5))


@wp.kernel(enable_backward=False, module="tests.staggered")
def index_kernel(coordinates: wp.array(dtype=float), count: int, out: wp.array(dtype=int)):
    t = wp.tid()
    out[t] = cell_index(coordinates[t], count)


def test_cells_of_points_off_the_grid_are_on_it() -> None:
    coordinates = [-np.inf, -3.0, 1.0, 1.99, 2.0, 4.0, 4.5, 9.0, np.inf, np.nan]
    out = wp.zeros(len(coordinates), dtype=int, device="cpu")
    wp.launch(
        index_kernel,
        len(coordinates),
        [wp.array(coordinates, dtype=float, device="cpu"), 4, out],
        device="cpu",
    )
    assert out.numpy().tolist() == [1, 1, 1, 1, 2, 4, 4, 4, 4, 1]


def test_a_window_of_steps_gives_the_window_it_has_now() -> None:
    """Parts of a simulation remember it, to clear these cells when the window has moved on."""
    device = wp.get_device("cpu")
    first, second = (Window.of([1, 1, 1], [end, 4, 4], device) for end in (3, 4))
    active = ActiveWindow(first)
    assert active.current is first
    assert first.current is first
    active.move_to(second)
    assert active.current is second
