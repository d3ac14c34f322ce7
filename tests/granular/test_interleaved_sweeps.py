"""Sweeps over pressure and friction.

They run in colors, as on CUDA, and over listed cells.
"""

import numpy as np
import pytest
import warp as wp
from test_sand_stress import make

from warp_lcp.granular.fields import VelocityFields
from warp_lcp.granular.stress_methods import APART, colors, interleaved_passes
from warp_lcp.grid.staggered import three_components
from warp_lcp.kernels import Rows


@pytest.mark.parametrize("dimension", [2, 3])
def test_colors_hold_each_cell_once_and_none_near_another(dimension: int) -> None:
    grid = make(dimension, 3).packing.grid
    found = [
        color.numpy() for color in colors(grid.shape, grid.domain.low, grid.domain.high, "cpu")
    ]
    inside = np.zeros(grid.size, dtype=int)
    np.add.at(inside, np.concatenate(found), 1)
    domain = np.zeros(grid.shape, dtype=int)
    domain[tuple(slice(a, b) for a, b in zip(grid.domain.low, grid.domain.high, strict=True))] = 1
    np.testing.assert_array_equal(inside.reshape(grid.shape), domain)
    for color in found:
        places = np.array(np.unravel_index(color, grid.shape))
        assert not ((places - places[:, :1]) % APART).any()


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_sweep_over_a_list_of_all_cells_is_that_over_the_grid(dimension: int) -> None:
    case, found = make(dimension, 5, cohesion=0.1), []
    grid, p, stress = case.packing.grid, case.packing, case.stress
    stress.velocity.find(stress.now)
    u = [field.numpy() for field in stress.velocity.u]
    every = colors(grid.shape, grid.domain.low, grid.domain.high, "cpu")
    cells = wp.array(
        np.sort(np.concatenate([color.numpy() for color in every])),
        dtype=wp.int32,
        device=grid.device,
    )
    for listed in (False, True):
        passes, now = interleaved_passes(dimension, listed=listed), wp.clone(stress.now)
        moved = [wp.array(field, dtype=wp.float32, device=grid.device) for field in u]
        structs = (
            p.fields,
            VelocityFields(*three_components(moved), *three_components(stress.velocity.edge), None),
        )
        rows = (
            Rows.entries(cells.size, grid.device)
            if listed
            else Rows.box(grid.domain.low, grid.domain.high, grid.device)
        )
        given = {"now": now, "numbers": stress.numbers} | ({"cells": cells} if listed else {})
        passes.pressure.bind(rows, *structs, omega=1.5, **given).launch()
        passes.friction.bind(rows, *structs, omega=1.0, **given).launch()
        found.append([now.numpy(), *(field.numpy() for field in moved)])
    for whole, one in zip(*found, strict=True):
        np.testing.assert_array_equal(whole, one)
    assert np.abs(found[0][0] - stress.now.numpy()).max() > 0.01
