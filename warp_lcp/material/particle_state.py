"""Validate particles and saved states."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from warp_lcp.grid.particles import Particles, ParticleTotals
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.operators.grid_poisson import SOLID


def signature(scene: ParticleScene, grid: StaggeredGrid) -> np.ndarray:
    """Return numbers that identify a scene's arrays, shape (7,).

    Cells of the domain along x, y and z, and others.
    """
    settings = scene.particles
    transfer = ("apic", "flip", "pic").index(settings.transfer)
    counts = grid.domain_counts
    return np.array(
        [*counts, grid.dimension, grid.spacing, settings.per_axis, transfer], dtype=np.float64
    )


def check_state(
    state: Mapping[str, np.ndarray],
    expected: Mapping[str, np.ndarray],
    *,
    changing: Collection[str] = (),
    solids_move: bool = False,
) -> None:
    """Refuse a state that does not belong to the same scene.

    Args:
        state: the state to continue from.
        expected: the current state of the simulation that will continue; it includes `cells`.
        changing: the particles' arrays, if their number changes.
        solids_move: whether solids may be where they have not been.

    Raises:
        ValueError: the arrays do not belong to this scene.
    """
    missing = sorted(expected.keys() - state.keys())
    if missing:
        raise ValueError(f"the state lacks {', '.join(missing)}: it does not belong to this scene")
    if not np.array_equal(state["signature"], expected["signature"]):
        raise ValueError(
            "the state's grid, spacing, number of particles a cell or transfer differ from this "
            "scene's"
        )
    if "interior" in state and "interior" not in expected:
        raise ValueError(
            "the state's particles are a narrow band: this scene has no particles.narrow_band"
        )
    for name, value in expected.items():
        array = np.asarray(state[name])
        if name in changing:
            value = np.empty((len(state["position"]), 3), dtype=value.dtype)
        if array.shape != value.shape or array.dtype != value.dtype:
            found, wanted = f"{array.dtype}{array.shape}", f"{value.dtype}{value.shape}"
            raise ValueError(f"the state's {name} is {found}: this scene has {wanted}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"the state's {name} holds values that are not finite")
    if not solids_move and not np.array_equal(state["cells"] == SOLID, expected["cells"] == SOLID):
        raise ValueError("the state's solids are not this scene's")


def other_spacing(
    state: Mapping[str, np.ndarray], scene: ParticleScene, grid: StaggeredGrid
) -> float:
    """Return the cells' width [m] of a state of the same scene on another grid.

    Raises:
        ValueError: the state differs in more than the grid.
    """
    before, now = np.asarray(state.get("signature", np.zeros(7))), signature(scene, grid)
    size = before[:3] * before[4], now[:3] * now[4]
    if not np.array_equal(before[[3, 5, 6]], now[[3, 5, 6]]) or not np.allclose(
        *(side[: grid.dimension] for side in size)
    ):
        raise ValueError(
            "the state's domain, number of particles a cell or transfer differ from this scene's"
        )
    return float(before[4])


def particle_trouble(
    particles: Particles, grid: StaggeredGrid, totals: ParticleTotals, end: np.ndarray
) -> str:
    """Return a message about particles that are not finite or outside the domain.

    The domain ends at `end` [m]. Empty if there are no such particles.
    """
    position, velocity = particles.position.numpy(), particles.velocity.numpy()
    if totals.bad_velocities:
        field, bad = (
            "velocity",
            ~((velocity.astype(np.float64) ** 2).sum(axis=1) <= np.finfo(np.float32).max),
        )
    elif totals.bad_positions:
        field, bad = "position", ~np.isfinite(position).all(axis=1)
    else:
        field, bad = (
            "position",
            ((position < 0.0) | (position > end))[:, : grid.dimension].any(axis=1),
        )
    indices, wrong = np.flatnonzero(bad), "outside the domain" if totals.finite else "not finite"
    if not len(indices):
        return ""
    # The cell into which it was last sorted.
    k, j, i = np.unravel_index(int(particles.key.numpy()[indices[0]]), grid.shape)
    # Counted from 0.
    cell = tuple(int(c) - 1 + before for c, before in zip((i, j, k), grid.origin, strict=True))
    return f"{field} is {wrong} in cell (x, y, z) = {cell} ({len(indices)} particles)"
