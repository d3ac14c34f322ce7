"""Active row segments: the part of the grid that particles reach.

A box around all particles may be mostly empty. Passes then visit only segments of its rows.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.grid.particle_loops import launch
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import SEGMENT, StaggeredGrid, Window
from warp_lcp.kernels import KernelFile

# Least cells of a box that is visited in part. Finding the part costs as much as a pass over the
# particles and one over the segments.
LEAST_CELLS = 1 << 17
MOST = 0.4  # largest active share of a box's segments
REST = 6  # steps between tests of a box that was not worth visiting in part

KERNELS = KernelFile(Path(__file__).parent / "headers/staggered.h")
MARK = KERNELS["warp_lcp.grid.active_rows.mark_segments"]


class ActiveRows:
    """Active row segments of a simulation's particles.

    A step writes values where it reaches and leaves zeros elsewhere. A pass that visits what this
    step and the step before it reach therefore leaves fields as if it had visited all cells.

    Args:
        grid: the grid of the particles.
        before: the active rows of another part of the same domain, whose cells begin a multiple of
            `SEGMENT` apart.
    """

    def __init__(self, grid: StaggeredGrid, before: "ActiveRows | None" = None) -> None:
        self.grid = grid
        nz, ny, nx = grid.shape
        self._marks: wp.array[wp.uint8] | None = None
        self._shape = nz, ny, -(-nx // SEGMENT)
        self._step = -1  # number of the last step
        self._now: np.ndarray | None = None  # segments that the last step reaches
        # Segments that the step before it reached; None if not known.
        self._before: np.ndarray | None = None
        self._rest = -1  # the step until which all is visited
        self.active = not grid.device.is_cuda and grid.size >= LEAST_CELLS
        if before is not None and self.active:
            self._copy_segments(before)

    def _copy_segments(self, other: "ActiveRows") -> None:
        """Copy the segments that another object has found.

        With the shift between the two origins, in cells along z and y and in segments along x,
        marks[p + shift] = marks_other[p] wherever both objects store the segment. Other marks are
        0.
        """
        if other._now is None:
            return
        shift = np.array(other.grid.origin) - self.grid.origin
        marks = np.zeros(self._shape, dtype=np.uint8)
        into, source = [], []
        for steps, mine, theirs in zip(
            (shift[2], shift[1], shift[0] // SEGMENT), marks.shape, other._now.shape, strict=True
        ):
            first, last = max(steps, 0), min(mine, theirs + steps)
            into.append(slice(first, max(last, first)))
            source.append(slice(first - steps, max(last, first) - steps))
        marks[tuple(into)] = other._now[tuple(source)]
        self._step, self._now = other._step, marks

    def window(self, box: Window, particles: Particles, grow: int, step: int) -> Window:
        """Return the window of cells that a step must visit.

        With n segments that this step or the previous one reaches, and N cells of the box, only
        these segments are visited if N >= LEAST_CELLS and SEGMENT n <= MOST N. Otherwise it is the
        whole box; if n was too large, no further test takes place for REST steps.

        Args:
            box: cells around everything that particles reach.
            particles: the particles.
            grow: cells that they reach beyond their own.
            step: number of the step; cells that the previous step reached are included.
        """
        cell_count = math.prod(end - start for start, end in zip(box.low, box.high, strict=True))
        if not self.active or cell_count < LEAST_CELLS or step < self._rest:
            self._step, self._now, self._before = step, None, None
            return box
        near = self._near(box, particles, grow)
        if step != self._step:
            self._step, self._before, self._now = step, self._now, None
        self._now = near if self._now is None else self._now | near
        if self._before is None:
            return box
        both = self._now | self._before
        if SEGMENT * np.count_nonzero(both) > MOST * cell_count:
            self._rest = step + REST
            return box
        return replace(box, near=both)

    def _near(self, box: Window, particles: Particles, grow: int) -> np.ndarray:
        """Return the marks of row segments that particles reach.

        A segment has SEGMENT cells of a row. Around the segment of a particle, `grow` rows and
        planes are marked, and ceil(grow / SEGMENT) segments along the row.
        """
        if self._marks is None:
            self._marks = wp.zeros(math.prod(self._shape), dtype=wp.uint8, device=self.grid.device)
        self._marks.zero_()
        in_z, in_y, in_x = self._shape
        launch(
            MARK,
            len(particles.position),
            self.grid,
            position=particles.position,
            marks=self._marks,
            segment=SEGMENT,
            in_z=in_z,
            in_y=in_y,
            in_x=in_x,
        )
        near = np.zeros(self._shape, dtype=np.uint8)
        part = tuple(slice(low, high) for low, high in zip(box.low, box.high, strict=True))
        part = (*part[:2], slice(part[2].start // SEGMENT, -(-part[2].stop // SEGMENT)))
        found = self._marks.numpy().reshape(self._shape)[part]
        for axis, cells in enumerate(
            (grow * (self.grid.dimension == 3), grow, -(-grow // SEGMENT))
        ):
            found = spread(found, cells, axis)
        near[part] = found
        return near


def spread(marks: np.ndarray, cells: int, axis: int) -> np.ndarray:
    """Return bytes that are 1 within some cells of a 1 along an axis."""
    if cells == 0:
        return marks
    width, all = 1, 2 * cells + 1
    made = np.pad(np.moveaxis(marks, axis, 0), ((0, cells), (0, 0), (0, 0)))
    while width < all:
        step = min(width, all - width)
        made[step:] |= made[:-step]
        width += step
    return np.moveaxis(made[cells:], 0, axis)
