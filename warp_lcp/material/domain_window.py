"""Grid window that follows the material through the domain."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.grid.particles import ParticleTotals
from warp_lcp.grid.staggered import StaggeredGrid

if TYPE_CHECKING:
    from warp_lcp.material.particle_scene import ParticleScene

# Cells. The ends of a part are multiples of this number, so that its coarse levels have the cells
# of the domain's coarse levels.
ALIGNED = 8
# Least cells of a domain whose grid may cover a part of it. For a smaller one the full grid costs
# less than new grids.
LEAST_CELLS = 1 << 18
# Cells, at most, of a new grid beyond the required ones on each side; or an eighth of the required
# cells, if that is more.
SPARE = 8
AHEAD = 16  # steps for which a new grid suffices at the material's current speed
START = 10  # cells around the initial material that its first steps reach
MOST = 0.5  # largest share of the domain's cells in a part; else the grid covers the whole domain
# Cells from which a domain needs much memory, and that share for it.
LARGE_CELLS, MOST_OF_LARGE = 1 << 26, 0.9
# Multiple of the cells that a material fills: most memory of a larger grid stays unwritten.
SPARSE = 32.0
LOOSE = 3.0  # multiple of the cells of a new grid: a larger grid is rebuilt

FAR = 1 << 30  # cells: beyond any domain

NO_PACE = (np.zeros(3), np.zeros(3))
Corner = Sequence[int] | np.ndarray  # cell (x, y, z), counted from 0


@dataclass(frozen=True)
class DomainWindow:
    """Choose the grid window around a material.

    The grid is kept while it covers the required cells and has at most `LOOSE` times as many cells
    as a new one. The choice is a function of the current grid and of the required cells only.

    Args:
        domain: the grid of the whole domain.
        follows: whether a grid may cover a part of it.
        always: cells that are always covered, as low and high corners (both included), shape (n, 2,
            3).
        endless: periodic axes, along which all cells are covered.
    """

    domain: StaggeredGrid
    follows: bool = True
    always: tuple[tuple[Corner, Corner], ...] = ()
    endless: Sequence[int] = ()

    @property
    def active(self) -> bool:
        """Return whether a grid may ever cover less than the domain."""
        return self.follows and self.domain.size >= LEAST_CELLS

    def around(
        self,
        low: Corner,
        high: Corner,
        now: StaggeredGrid | None = None,
        pace: Sequence[np.ndarray] = NO_PACE,
        *,
        filled: float = math.inf,
    ) -> StaggeredGrid:
        """Return a grid that covers a box of cells.

        Args:
            low: first cell (x, y, z) of the domain, counted from 0; cells outside the domain are
                ignored.
            high: last cell.
            now: the current grid, which is returned if it is suitable.
            pace: cells per step by which the box's low and high sides may move outward, shape (3,)
                each, see `pace_of`.
            filled: number of cells that the material would fill.
        """
        if not self.active:
            return self.domain
        corners = np.array([(low, high), *self.always])
        last = np.array(self.domain.counts) - 1
        first, final = (
            np.clip(corners[:, 0].min(axis=0), 0, last),
            np.clip(corners[:, 1].max(axis=0), 0, last),
        )
        laid = self._laid(first, final, pace)
        if now is not None and now.covers(first, final) and now.size <= LOOSE * laid.size:
            return now
        return replace(laid, sparse=True) if laid.size > SPARSE * filled else laid

    def beyond(self, high: np.ndarray) -> str:
        """Return an error message if a box of cells reaches beyond the domain, else "".

        `high` is its last cell. The message names the axes.
        """
        axes = [
            axis for axis in range(self.domain.dimension) if high[axis] >= self.domain.counts[axis]
        ]
        most, names = max(self.domain.counts), " and ".join("xyz"[axis] for axis in axes)
        if not axes:
            return ""
        return (
            f"the material extends to {most} cells along {names}, the largest possible domain; use "
            "larger cells (domain.spacing), let a "
            "drain or an open side remove it, or give the domain a size"
        )

    def at(self, box: np.ndarray | None) -> StaggeredGrid:
        """Return the grid of a state's `box`; without a box, that of the domain.

        Raises:
            ValueError: the box is none of the domain's.
        """
        if box is None:
            return self.domain
        low, high = np.asarray(box, dtype=np.int64)
        if not ((low >= 0) & (low < high) & (high <= np.array(self.domain.counts))).all():
            raise ValueError(
                f"the state's box from cell {low.tolist()} to {high.tolist()} is not in this "
                f"scene's {self.domain.counts}"
            )
        return self._part(low, high)

    def _laid(
        self, first: np.ndarray, final: np.ndarray, pace: Sequence[np.ndarray]
    ) -> StaggeredGrid:
        # Returns a new grid around the cells first ... final. On each side it has AHEAD * pace more
        # cells, the way of the material in AHEAD steps, at most max(SPARE, an eighth of the
        # required cells); the ends are then rounded outward to multiples of ALIGNED. If that is a
        # large part of the domain, the whole domain is returned.
        counts, most = np.array(self.domain.counts), np.maximum(SPARE, (final - first + 1) // 8)
        before, behind = (
            np.minimum(np.ceil(AHEAD * np.asarray(side)), most).astype(int) for side in pace
        )
        low = np.maximum((first - before) // ALIGNED * ALIGNED, 0)
        high = np.minimum(-(-(final + 1 + behind) // ALIGNED) * ALIGNED, counts)
        for axis in self.endless:
            low[axis], high[axis] = 0, counts[axis]
        part = self._part(low, high)
        most = MOST if self.domain.size < LARGE_CELLS else MOST_OF_LARGE
        return part if part.size <= most * self.domain.size else self.domain

    def _part(self, low: np.ndarray, high: np.ndarray) -> StaggeredGrid:
        domain = self.domain
        if not low.any() and tuple(high) == domain.counts:
            return domain
        (x, y, z), (nx, ny, nz) = low.tolist(), (high - low).tolist()
        return StaggeredGrid(
            (nx, ny, nz),
            domain.spacing,
            domain.dimension,
            domain.device,
            origin=(x, y, z),
            whole=domain.counts,
        )


def start_of(scene: ParticleScene, device: wp.DeviceLike) -> tuple[DomainWindow, StaggeredGrid]:
    """Return the grid window of a scene, and its first grid.

    The grid covers the materials at the start and the sources.
    """
    domain_grid = StaggeredGrid(scene.cell_counts, scene.spacing, scene.dimension, device)
    boxes = [shape.bounds(scene.dimension) for shape in (*scene.source, *scene.materials()[1])]
    corners = [
        cells_between(box[0], box[1], domain_grid.spacing, START)
        for box in boxes
        if box is not None
    ]
    follows = scene.domain.follow and bool(corners) and len(corners) == len(boxes)
    coverage = DomainWindow(
        domain_grid, follows, tuple(corners[: len(scene.source)]), scene.endless
    )
    low, high = zip(*corners, strict=True) if follows else ([0], [0])
    return coverage, coverage.around(np.min(low, axis=0), np.max(high, axis=0))


def carry_over(
    state: Mapping[str, np.ndarray],
    before: StaggeredGrid,
    now: StaggeredGrid,
    fresh: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Return the state of one grid for another grid.

    Fields have the old values where both grids cover the domain, and those of `fresh` elsewhere.
    All other entries stay unchanged.

    Args:
        state: arrays; the fields' last three axes have the stored shape.
        before: its grid.
        now: the other one.
        fresh: arrays of the other grid by the same names (updated).
    """
    out, old, new = dict(state), _common(before, now), _common(now, before)
    for name, values in state.items():
        if values.shape[-3:] == before.shape and name in fresh:
            out[name] = fresh[name]
            out[name][..., *new] = values[..., *old]
    return out


def _common(grid: StaggeredGrid, other: StaggeredGrid) -> tuple[slice, slice, slice]:
    """Return the slices of a grid's fields that another grid stores as well.

    They include the rings where these are the domain's.
    """

    def along(axis: int) -> slice:
        ends = []
        for g in (grid, other):
            low, high = g.origin[axis], g.origin[axis] + g.counts[axis]
            ends.append((low + (low > 0), high + 1 + (high == g.domain_counts[axis])))
        low, high = max(end[0] for end in ends), min(end[1] for end in ends)
        return slice(low - grid.origin[axis], max(high, low) - grid.origin[axis])

    return along(2), along(1), along(0)


def cells_between(
    low: np.ndarray, high: np.ndarray, spacing: float, grow: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the last cell of a box, enlarged by `grow` on each side.

    The corners `low` and `high` are in [m].
    """
    first, last = (
        np.clip(np.nan_to_num(np.floor(np.asarray(corner) / spacing)), -FAR, FAR)
        for corner in (low, high)
    )
    return first.astype(int) - grow, last.astype(int) + grow


def pace_of(totals: ParticleTotals, dt: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells per step by which a box around particles may grow at its sides.

    For the low and the high sides. It is the sum of the mean velocity and of the largest velocity
    relative to it.
    """
    drift = totals.velocity * dt / spacing
    apart = max(totals.max_speed * dt / spacing - float(np.linalg.norm(drift)), 0.0)
    return np.maximum(-drift, 0.0) + apart, np.maximum(drift, 0.0) + apart


def travel(speed: float, acceleration: float, dt: float, spacing: float) -> int:
    """Return the most cells that something can move in a time step [s].

    It has a speed [m/s] and an acceleration [m/s^2].
    """
    way = (speed + abs(acceleration) * dt) * dt / spacing
    return math.ceil(min(way, 1e6)) if math.isfinite(way) else 0
