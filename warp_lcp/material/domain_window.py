"""The part of a domain that a simulation's grid covers: as large as its material, not as its box."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_lcp.grid.particles import ParticleTotals
from warp_lcp.grid.staggered import StaggeredGrid

if TYPE_CHECKING:
    from warp_lcp.material.particle_scene import ParticleScene

# cells, of which a part's ends are multiples: its coarse levels then have the cells that those of
# the domain have
ALIGNED = 8
# of a domain whose grid need not cover all of it: a smaller one costs less than laying grids
LEAST_CELLS = 1 << 18
# cells at most that a grid has to spare on a side when it is laid, an eighth of what it covers if
# that is more
SPARE = 8
AHEAD = 16  # steps that it is laid for, as the material moves now
START = 10  # cells around a material at the start that its first steps reach
MOST = 0.5  # of the domain's cells that a part may have; else the grid covers all of it
LARGE_CELLS, MOST_OF_LARGE = 1 << 26, 0.9  # of a domain whose cells, all of them, are much memory
SPARSE = 32.0  # times as many cells as a material fills: a grid that has more is hardly written to
LOOSE = 3.0  # times the cells of a grid that would be laid now: one that has more is laid anew

FAR = 1 << 30  # cells: beyond any domain

NO_PACE = (np.zeros(3), np.zeros(3))
Corner = Sequence[int] | np.ndarray  # cell (x, y, z), counted from 0


@dataclass(frozen=True)
class DomainWindow:
    """Lay grids around a material.

    A grid that still covers what it must stays, unless it has become `LOOSE`: where grids are laid
    is a function of the grid there was and of what it must cover.

    Args:
        domain: the grid of the whole domain.
        follows: whether a grid may cover a part of it.
        always: cells that are covered whatever the material does, as low and high corners (both
            included), shape (n, 2, 3).
        endless: axes without an end, along which all cells are covered.
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
            low: first cell (x, y, z) of the domain, counted from 0; what lies outside the domain
                does not count.
            high: last cell.
            now: the grid there is, which is returned if it will do.
            pace: cells a step that the box's low and high sides may move outward, shape (3,) each,
                see `pace_of`.
            filled: how many cells the material would fill.
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
        """Say along which axis a box of cells that ends with this one reaches beyond the domain; "" if it does not."""
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
        """Return the grid of a state's `box`, the domain's if it has none.

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


def start_of(scene: ParticleScene, device: Any) -> tuple[DomainWindow, StaggeredGrid]:
    """Return what lays a scene's grids, and the first one, around its materials at the start and its sources."""
    whole = StaggeredGrid(scene.cell_counts, scene.spacing, scene.dimension, device)
    boxes = [shape.bounds(scene.dimension) for shape in (*scene.source, *scene.materials()[1])]
    corners = [
        cells_between(box[0], box[1], whole.spacing, START) for box in boxes if box is not None
    ]
    follows = scene.domain.follow and bool(corners) and len(corners) == len(boxes)
    coverage = DomainWindow(whole, follows, tuple(corners[: len(scene.source)]), scene.endless)
    low, high = zip(*corners, strict=True) if follows else ([0], [0])
    return coverage, coverage.around(np.min(low, axis=0), np.max(high, axis=0))


def carry_over(
    state: Mapping[str, np.ndarray],
    before: StaggeredGrid,
    now: StaggeredGrid,
    fresh: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Return a state of one grid for another: fields where both cover the domain, those of `fresh` elsewhere, all else as it is.

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
    """Return where the stored cells lie in a grid's fields that both know: their rings too where that is the domain's."""

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
    """Return the first and the last cell of a box between two corners [m], with some more on each side."""
    first, last = (
        np.clip(np.nan_to_num(np.floor(np.asarray(corner) / spacing)), -FAR, FAR)
        for corner in (low, high)
    )
    return first.astype(int) - grow, last.astype(int) + grow


def pace_of(totals: ParticleTotals, dt: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return how many cells a step the low and high sides of the box around particles may move outward: with all of them, and apart."""
    drift = totals.velocity * dt / spacing
    apart = max(totals.max_speed * dt / spacing - float(np.linalg.norm(drift)), 0.0)
    return np.maximum(-drift, 0.0) + apart, np.maximum(drift, 0.0) + apart


def travel(speed: float, acceleration: float, dt: float, spacing: float) -> int:
    """Return how many cells something may move in a time step [s], given its speed [m/s] and an acceleration [m/s^2]."""
    way = (speed + abs(acceleration) * dt) * dt / spacing
    return math.ceil(min(way, 1e6)) if math.isfinite(way) else 0
