"""Liquid on solids that cut cells: choice of kernels, pressure on a slope."""

import math
from typing import Any

import numpy as np
import pytest

import warp_lcp as wl
from small_liquids import GRAVITY, advance, box, create, scene
from warp_lcp.material.boundary import CutBoundary, WholeCells

SLOPE = math.radians(30)
V = [
    {"shape": "plane", "point": [0.5, 0.1], "normal": [side * math.sin(SLOPE), math.cos(SLOPE)]}
    for side in (-1, 1)
]


def pool(resolution: int = 24, **tables: Any) -> Any:
    """Return a pool of depth 0.4 over two slopes that meet in the middle."""
    return create(
        scene(
            size=[1.0, 1.0], resolution=resolution, liquid=[box([0.0, 0.0], [1.0, 0.5])], **tables
        )
    )


@pytest.mark.parametrize(
    ("solid", "kind"),
    [
        ([], WholeCells),
        ([box([0.5, 0.0], [0.75, 0.25])], WholeCells),  # on whole cells
        ([box([0.5, 0.0], [0.77, 0.25])], CutBoundary),
        ([box([0.5, 0.0], [0.75, 0.25], rotate=45)], CutBoundary),
    ],
)
def test_only_solids_that_cut_cells_cost_face_coefficients(
    solid: list[dict[str, Any]], kind: type
) -> None:
    simulation = pool(16, solid=solid)
    assert type(simulation.boundary) is kind
    simulation.step(0.01)
    assert bool(simulation.boundary.open) == (kind is CutBoundary)


def test_whole_cells_keep_the_unit_weights_of_the_operator() -> None:
    """Unit weights of the operator on whole cells.

    A free surface between cells affects the diagonal alone, so that the kernels for unit weights
    apply.
    """
    cells = np.full((4, 5), wl.FLUID)
    cells[-1] = wl.AIR
    A = wl.GridPoisson(cells, shift=0.5, device="cpu")
    assert A.stencil.weights is None


@pytest.mark.parametrize("resolution", [16, 32])
def test_the_pressure_over_slopes_is_that_of_the_depth(resolution: int) -> None:
    """Hydrostatic pressure over slopes.

    p = rho g (h - y) at every liquid cell's center, cut or not. With stairs or a clamped surface it
    is off by half a cell.
    """
    simulation = pool(resolution, solid=V)
    advance(simulation, 0.2)
    dx = simulation.grid.spacing
    pressure = simulation.projection.pressures(1000.0)[1] / (1000.0 * GRAVITY * dx)
    liquid = simulation.projection.cells.numpy()[1] == wl.FLUID
    rows = np.arange(resolution + 2)[:, None] - 0.5
    error = np.where(liquid, pressure - (0.5 / dx - rows), 0.0)
    assert liquid.sum() > 0.2 / dx**2
    assert abs(error[liquid].mean()) < 0.02
    assert np.abs(error).max() < 0.12


def test_no_particle_enters_a_solid() -> None:
    disc = {"shape": "sphere", "center": [0.55, 0.15], "radius": 0.17}
    simulation = create(
        scene(size=[1.0, 0.6], resolution=30, liquid=[box([0.0, 0.0], [0.3, 0.5])], solid=[disc])
    )
    rows = advance(simulation, 0.5)
    position = simulation.particles.position.numpy()
    far = np.hypot(position[:, 0] - 0.55, position[:, 1] - 0.15)
    assert max(row["stopped"] for row in rows) > 0
    # Chord of a cell.
    assert (
        far.min()
        > 0.17 - 0.01 * simulation.grid.spacing - 0.125 * simulation.grid.spacing**2 / 0.17
    )
    assert {row["solve_status"] for row in rows} == {"CONVERGED"}
