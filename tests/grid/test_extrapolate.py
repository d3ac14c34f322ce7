import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_lcp.grid.extrapolate import BLOCKED, UNKNOWN, extrapolate
from warp_lcp.grid.staggered import StaggeredGrid

FLAT = StaggeredGrid((8, 6, 1), 0.1, 2)
SOLID = StaggeredGrid((8, 6, 5), 0.1, 3)


def reference(
    known: np.ndarray, field: np.ndarray, layers: int, start: int = 1, fill: int = UNKNOWN
) -> tuple[np.ndarray, np.ndarray]:
    """Extrapolate out of place with NumPy."""
    known, field = known.copy(), field.astype(np.float64)
    for layer in range(start, start + layers):
        sources = np.pad((known > 0) & (known <= layer), 1)
        values = np.pad(field, 1) * sources
        count, total = np.zeros(field.shape), np.zeros(field.shape)
        for axis in range(3):
            for side in (-1, 1):
                inner = (slice(1, -1),) * 3
                count += np.roll(sources, side, axis)[inner]
                total += np.roll(values, side, axis)[inner]
        new = (known == fill) & (count > 0)
        field[new] = total[new] / count[new]
        known[new] = layer + 1
    return known, field


@pytest.mark.parametrize("grid", [FLAT, SOLID], ids=["2d", "3d"])
@settings(max_examples=30, deadline=None)
@given(
    random_seed=st.integers(0, 10**6),
    layers=st.integers(0, 6),
    fill=st.sampled_from([UNKNOWN, BLOCKED]),
)
def test_layers_are_means_of_known_neighbors(
    grid: StaggeredGrid, random_seed: int, layers: int, fill: int
) -> None:
    rng = np.random.default_rng(random_seed)
    known = rng.choice([BLOCKED, UNKNOWN, 1], size=grid.shape, p=[0.3, 0.6, 0.1]).astype(np.int8)
    if grid.dimension == 2:
        known[[0, 2]] = BLOCKED + UNKNOWN - fill  # planes not in use are unchanged
    field = rng.normal(size=grid.shape).astype(np.float32)
    marks, values = (
        wp.array(known, dtype=wp.int8, device="cpu"),
        wp.array(field, dtype=wp.float32, device="cpu"),
    )
    extrapolate(grid.everywhere, marks, values, layers, fill=fill)
    expected_known, expected = reference(known, field, layers, fill=fill)
    assert (marks.numpy() == expected_known).all()
    assert values.numpy() == pytest.approx(expected, abs=1e-5)


def test_a_linear_field_continues_along_the_boundary_of_the_known() -> None:
    k, j, i = np.meshgrid(*(np.arange(n) for n in SOLID.shape), indexing="ij")
    linear = (2.0 * j - 3.0 * k).astype(np.float32)
    known = (i < 3).astype(np.int8)
    marks = wp.array(known, dtype=wp.int8, device="cpu")
    values = wp.array(np.where(known, linear, 1e6), dtype=wp.float32, device="cpu")
    extrapolate(SOLID.everywhere, marks, values, 4)
    assert values.numpy()[..., :7] == pytest.approx(linear[..., :7])
    assert (values.numpy()[..., 7:] == 1e6).all()
    assert marks.numpy()[2, 2].tolist() == [1, 1, 1, 2, 3, 4, 5, 0, 0, 0]


def test_later_layers_continue_from_a_mark() -> None:
    known = np.full(FLAT.shape, BLOCKED, np.int8)
    known[1, 2:4, 2] = 5, UNKNOWN
    field = np.zeros(FLAT.shape, np.float32)
    field[1, 2, 2] = 7.0
    marks, values = (
        wp.array(known, dtype=wp.int8, device="cpu"),
        wp.array(field, dtype=wp.float32, device="cpu"),
    )
    extrapolate(FLAT.everywhere, marks, values, 1, start=4)
    assert marks.numpy()[1, 3, 2] == UNKNOWN
    extrapolate(FLAT.everywhere, marks, values, 1, start=5)
    assert (marks.numpy()[1, 3, 2], values.numpy()[1, 3, 2]) == (6, 7.0)


def test_too_many_layers_are_refused() -> None:
    with pytest.raises(ValueError, match="layers"):
        extrapolate(FLAT.everywhere, FLAT.field(wp.int8), FLAT.field(), 127)
