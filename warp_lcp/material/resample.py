"""Resample material for another grid, with as many particles a cell as before."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial import cKDTree

from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid

# x^(d+1) = x + 1: the steps of a sequence that fills a cube evenly.
PLASTIC = {2: 1.32471795724474602596, 3: 1.22074408460575947536}


def resampled(
    state: Mapping[str, np.ndarray],
    grid: StaggeredGrid,
    admits: Callable[[np.ndarray], np.ndarray],
    *,
    spacing: float,
    per_axis: int,
    random_seed: int,
) -> tuple[dict[str, np.ndarray], int]:
    """Return the particles of a state, made finer or coarser for another grid.

    With k > 1 times as many particles as before, each is replaced by k on average, spread over the
    square or cube that was its share of a cell at rest. Its velocity is extrapolated there by its
    gradient. With k < 1 one of every 1/k stays, chosen at random among neighbors. A uniform
    velocity is added, so that momentum is conserved but for the rounding of the particles' number.

    Args:
        state: `position` [m], `velocity` [m/s], for APIC `affine_0` ... [1/s] and what particles
            take along, `kept`; float32, shape (n, 3), about in the order of the cells.
        grid: the new grid.
        admits: returns a mask of the points [m], shape (n, 3), at which a particle may be.
        spacing: spacing of the old grid [m].
        per_axis: particles along the edge of a cell at rest, on both grids.
        random_seed: seed of the places.

    Returns:
        The arrays by name, and how many particles had to be moved out of solids.

    Raises:
        ValueError: no particle is left.
    """
    position, dimension = state["position"].astype(np.float64), grid.dimension
    share = (spacing / grid.spacing) ** dimension  # new particles for an old one
    count, rng = round(share * len(position)), np.random.default_rng(random_seed)
    if count == 0 < len(position):
        raise ValueError(
            f"domain.resolution: {len(position)} particles are not enough for one on a grid of "
            f"{grid.spacing:.4g} m"
        )
    offset = np.zeros((count, 3))
    if share > 1.0:
        ends = np.floor(share * np.arange(len(position) + 1) + 0.5).astype(np.int64)
        ends[-1] = count
        parent = np.repeat(np.arange(len(position)), np.diff(ends))
        number, shift = np.arange(count) - ends[parent], rng.random((len(position), dimension))
        steps = PLASTIC[dimension] ** -np.arange(1.0, dimension + 1)
        offset[:, :dimension] = ((shift[parent] + number[:, None] * steps) % 1.0 - 0.5) * (
            spacing / per_axis
        )
    else:
        parent = np.minimum(
            (np.arange(count) + rng.random(count)) / share, len(position) - 1
        ).astype(np.int64)
    size = grid.extent[:dimension]
    margin = 1.1 * MARGIN * grid.spacing  # more than is asked for: float32 rounds
    positions = _placed(position[parent], offset, admits, margin, size - margin)
    moved = np.linalg.norm(positions - position[parent] - offset, axis=1) > grid.spacing * MARGIN
    velocity = state["velocity"].astype(np.float64)[parent]
    arrays = {
        name: value[parent] for name, value in state.items() if name.startswith(("affine_", "kept"))
    }
    for axis in range(dimension if "affine_0" in arrays else 0):
        velocity[:, axis] += (arrays[f"affine_{axis}"] * (positions - position[parent])).sum(axis=1)
    if len(parent):
        velocity += state["velocity"].mean(axis=0, dtype=np.float64) - velocity.mean(axis=0)
    return arrays | {
        "position": positions.astype(np.float32),
        "velocity": velocity.astype(np.float32),
    }, int(moved.sum())


def resampling_notes(
    before: int, after: int, moved: int, spacing: float, grid: StaggeredGrid
) -> list[str]:
    """Return notes for the user about a resampled material.

    Args:
        before: particles on the old grid.
        after: particles on the new one.
        moved: particles that were moved out of solids.
        spacing: spacing of the old grid [m].
        grid: the new one.
    """
    change = after * grid.cell_volume / (before * spacing**grid.dimension) - 1.0 if before else 0.0
    notes = [
        f"resampled from cells of {spacing:.4g} m to {grid.spacing:.4g} m: {after} particles "
        f"replace {before}, {change:+.1e} of the mass; "
        "pressure and grid fields start from zero; later steps differ from those of the original "
        "run"
    ]
    return [*notes, f"{moved} resampled particles were moved out of solids"] if moved else notes


def _placed(
    start: np.ndarray,
    offset: np.ndarray,
    admits: Callable[[np.ndarray], np.ndarray],
    low: float,
    high: np.ndarray,
) -> np.ndarray:
    """Return start + offset where a particle may be there, else start.

    If start is not admitted either, it is the nearest admitted place of another particle.
    """
    dimension = len(high)

    def inside(points: np.ndarray) -> np.ndarray:
        points[:, :dimension] = np.clip(points[:, :dimension], low, high)
        return points

    positions, plain = inside(start + offset), inside(start.copy())
    wrong = ~admits(positions)
    positions[wrong] = plain[wrong]
    wrong[wrong] = ~admits(positions[wrong])
    if wrong.any() and not wrong.all():
        free = positions[~wrong]
        positions[wrong] = free[cKDTree(free).query(positions[wrong])[1]]
    return positions
