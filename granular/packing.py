"""Packing of sand on the grid: cell fractions, face masses, stressed cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.granular import packing_kernels as kernels
from warp_lcp.granular.fields import SandFields
from warp_lcp.grid.cell_kernel import launch_list
from warp_lcp.grid.domain_sides import PeriodicSides
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window, three_components
from warp_lcp.kernels.launch_graph import Launch, LaunchGraph, clear, launch
from warp_lcp.kernels.layout import put
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar

if TYPE_CHECKING:
    from warp_lcp.distributed.halo import StarForest
    from warp_lcp.granular.cut_walls import CutWalls

REACH = 2  # layers of ghost cells whose stresses act on velocities in the box
SHEARS = {2: ((0, 1),), 3: ((0, 1), (0, 2), (1, 2))}  # the axes of each shear


class Packing:
    """Packing of sand in a step, and the cells in which stresses act.

    phi is the volume fraction of grains in a cell, relative to the densest packing. Sampling noise
    of the particles can make phi exceed 1, which the stresses do not correct. From FULL on a cell
    counts as full. The mass of a face is the mean of its cells; faces with less than 0.02 are
    empty, those with less than 0.1 count as 0.1. In the pressure problem a cell with phi > 0.3
    beside air counts as full, so that a surface of partly filled cells has pressure, and thus
    friction; its mass is still phi.

    On ranks the result is correct in the box and `REACH` layers around it if the density is correct
    in all ghost layers.

    Args:
        grid: the grid.
        base: int8, SOLID or AIR.
        capacity: float32, open share of a cell's kernel.
        sides: exchange across periodic axes, if any.
        cut: solids that cut cells, if any; only the cells that they fill completely are SOLID in
            `base`, and no face has their velocity in `update`.

    Attributes:
        base: the argument of the same name.
        fraction: phi, float32.
        kind: int8 FLUID where a cell holds sand (phi > 0.02), AIR, SOLID.
        flags: uint8 bits of a cell, see `granular.stress_layout`.
        drive: free volume of a cell as a velocity: at most FULL - phi, and at most the mean free
            fraction around it, times dx / dt [m/s], float32.
        mass, inverse: mass of each component's faces, in units of a full face, float32; inverse is
            0 on faces that cannot move.
        start: velocity of each component before the stresses [m/s], float32.
        share: weight of a cell's copy on the edges of each shear, float32, see
            `granular.stress_layout`.
        stiff: bound of the friction's diagonal in a cell, float32.
        spans: int32, first and one past the last cell of each row that stresses reach, shape
            (*grid.shape[:2], 2).
        nodes: window of the lower faces and edges of all cells, including the domain's upper side.
        strained: window of edges whose strain rates enter the counted cells.
        moved: window of faces whose velocities enter these edges and the counted cells.
        stressed: window of edges whose stresses act on these faces.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        base: wp.array,
        capacity: wp.array,
        *,
        sides: PeriodicSides | None = None,
        cut: CutWalls | None = None,
    ) -> None:
        self.grid, self.base, self._capacity, self.sides, self.cut = (
            grid,
            base,
            capacity,
            sides,
            cut,
        )
        self.fraction, self.kind, self.flags, self.drive = (
            grid.field(),
            grid.field(wp.int8),
            grid.field(wp.uint8),
            grid.field(),
        )
        wp.copy(self.kind, base)
        self.mass, self.inverse, self.start = grid.faces(), grid.faces(), grid.faces()
        self.share = [grid.field() for _ in SHEARS[grid.dimension]]
        self.stiff = grid.field()
        self._own = wp.zeros((*grid.shape[:2], 2), dtype=wp.int32, device=grid.device)
        self.spans = wp.zeros_like(self._own)
        low, high = grid.domain.low, grid.domain.high
        more = 1 if grid.dimension == 3 else 0
        self.nodes = Window(low, (high[0] + more, high[1] + 1, high[2] + 1), grid.device)
        self.counted = grid.part.owned
        # Exchange of this step's cells on ranks; always the same object, since recorded exchanges
        # read it.
        self._forest: StarForest | None = None
        self.strained, self.moved, self.stressed = (
            self._around(0, 1),
            self._around(1, 1),
            self._around(1, 2),
        )
        self._known = grid.part.stored
        # Number of sand cells and largest fraction of each row.
        self._rows = wp.zeros((2, *grid.shape[:2]), dtype=wp.float64, device=grid.device)
        self._found = DeviceScalar(grid.device, 2)
        self._rate = Scalar()  # dx / dt [m/s]
        # Cells and nodes of an update, and the window of the last one.
        self._cells, self._nodes = ActiveWindow(grid.domain), ActiveWindow(self.nodes)
        self._last: Window = grid.domain
        self._update = LaunchGraph(grid.device, self._launch)
        if sides is not None:  # the neighbors of a row may be at its other end
            self.spans.assign(np.full((*grid.shape[:2], 2), (low[2], high[2] + 1), dtype=np.int32))

    def update(
        self,
        density: wp.array,
        velocity: Sequence[wp.array],
        dt: float,
        solid: Sequence[wp.array] = (),
        window: Window | None = None,
    ) -> None:
        """Update the packing from the particles' density and velocity.

        Cells without sand, now and at the last update, keep their values, which nothing reads: at
        most `drive` and `start` would change there.

        Args:
            density: density of the particles, relative to the densest packing, float32.
            velocity: u* of each component [m/s], including gravity.
            dt: time step [s].
            solid: velocity of the solids on each component's faces [m/s]; empty if they are at
                rest.
            window: cells that hold all sand, with two to spare on each side; None for all cells.
        """
        self._rate.value = self.grid.spacing / dt
        self._move_windows(None if solid else window)
        self._update.run(
            density,
            velocity,
            solid,
            variant=tuple(field.ptr for field in (density, *velocity, *solid)),
        )
        self._found.changed()

    def forget_window(self) -> None:
        """Let the next update visit all cells, after fields were set from outside."""
        self._last = self.grid.domain

    def _move_windows(self, window: Window | None) -> None:
        """Set the cells and nodes of an update: those of its window and of the last one.

        All cells are visited on ranks, with periodic sides, and where sand fills the domain.
        """
        domain, nodes = self.grid.domain, self.nodes
        alone = self.sides is None and not self.grid.part.shared
        box = domain.common(Window(window.low, window.high, domain.device)) if window else None
        if box is None or not alone:
            box = domain
        low = [min(pair) for pair in zip(box.low, self._last.low, strict=True)]
        high = [max(pair) for pair in zip(box.high, self._last.high, strict=True)]
        self._last = box
        self._cells.move_to(Window.of(low, high, domain.device))
        more = [n - d for n, d in zip(nodes.high, domain.high, strict=True)]
        high = [h + m for h, m in zip(high, more, strict=True)]
        self._nodes.move_to(Window.of(low, high, domain.device))

    def find_ghosts(self, layers: int) -> None:
        """Find the ghost cells with sand, for `join`; collective.

        Args:
            layers: layers of a stress field.
        """
        if self.grid.part.comm is not None:
            sand = self.flags.numpy() != 0
            self._forest = self.grid.part.forest(layers, REACH, which=sand, into=self._forest)

    @property
    def sand_cells(self) -> int:
        """Number of counted cells whose flags are not 0."""
        return int(self._found.numpy()[0])

    @property
    def counts(self) -> wp.array:
        """Return `sand_cells` and `densest` as a device array, float64, shape (2,)."""
        return self._found.array

    @property
    def densest(self) -> float:
        """Largest fraction of a cell, relative to the densest packing.

        Only cells with more than half of their kernel open count.
        """
        return float(self._found.numpy()[1])

    def _launch(
        self, density: wp.array, velocity: Sequence[wp.array], solid: Sequence[wp.array]
    ) -> None:
        """Launch an update.

        Each kernel needs the result of the one before: fractions of cells; kinds, flags and free
        volumes; masses of faces; fronts; weights of edges; stiffness of cells; spans of the rows.
        """
        grid, dimension = self.grid, self.grid.dimension
        cells, nodes = self._cells, self._nodes
        cells.launch(kernels.fraction_kernel, [self.base, self._capacity, density, self.fraction])
        if self.sides is not None:
            self.sides.wrap(self.fraction)
        openings, volume, around = (
            (None, None, [None] * 3)
            if self.cut is None
            else (self.cut.openings, self.cut.volume, self.cut.around)
        )
        inputs = [
            self.base,
            self._capacity,
            self.fraction,
            grid.planes,
            self._rate,
            volume,
            self.kind,
            self.flags,
            self.drive,
        ]
        cells.launch(kernels.contents_kernel, inputs)
        if self.sides is not None:
            self.sides.wrap(self.flags, self.kind)
        for axis in range(dimension):
            moving = solid[axis] if solid else None
            fields = [
                velocity[axis],
                moving,
                openings,
                self.start[axis],
                self.mass[axis],
                self.inverse[axis],
            ]
            nodes.launch(kernels.face_kernel, [axis, self.base, self.fraction, *fields])
            if self.sides is not None:
                self.sides.wrap(self.start[axis], self.mass[axis], self.inverse[axis])
        mass, start, inverse = (
            put(kernels.Faces(), dict(zip("xyz", fields, strict=False)))
            for fields in (self.mass, self.start, self.inverse)
        )
        swept = None if self.cut is None else self.cut.swept
        cells.launch(
            kernels.front_kernel,
            [dimension, self._rate, openings, mass, start, self.fraction, swept, self.drive],
        )
        for (alpha, beta), part, share in zip(SHEARS[dimension], around, self.share, strict=False):
            nodes.launch(
                kernels.edge_kernel,
                [
                    alpha,
                    beta,
                    self.base,
                    self.flags,
                    self.inverse[alpha],
                    self.inverse[beta],
                    part,
                    share,
                ],
            )
        shares = put(kernels.Faces(), dict(zip("xyz", self.share, strict=False)))
        cells.launch(
            kernels.stiffness_kernel, [dimension, self.flags, inverse, shares, openings, self.stiff]
        )
        self._launch_counts(density)
        if self.sides is not None:
            return  # the spans are whole rows
        grid.domain.launch_rows(kernels.span_kernel, [self.flags, self._own])
        self.nodes.launch_rows(kernels.widen_kernel, [self._own, self.spans])

    def _launch_counts(self, density: wp.array) -> None:
        """Launch the computation of `sand_cells` and `densest`."""
        self.counted.launch_rows(kernels.count_kernel, [self.flags, self._rows])
        self._known.launch_rows(
            kernels.most_kernel, [self.base, self._capacity, density, self._rows]
        )
        clear(self._found.array)
        rows = self._rows.shape[1] * self._rows.shape[2]
        launch_list(
            kernels.fold_kernel,
            rows,
            [self._rows, self._found.array],
            device=self.grid.device,
            ordered=True,
        )

    def _around(self, below: int, above: int) -> Window:
        """Return the window of counted cells, grown by layers of nodes.

        `below` and `above` layers on the lower and upper sides, within the grid.
        """
        low, high = [n - below for n in self.counted.low], [n + above for n in self.counted.high]
        window = Window.of(low, high, self.grid.device)
        return window.common(self.nodes) or self.nodes

    def join(self, stress: wp.array, *, launch: Launch = launch) -> None:
        """Fill `REACH` layers of ghost cells of a stress field; collective.

        Called after `find_ghosts`. Cells beyond periodic sides are filled, too. Cells without sand
        have stresses of 0 on all ranks.
        """
        if self._forest is not None:
            self.grid.part.fill_task(stress, forest=self._forest).launch(launch)
        if self.sides is not None:
            self.sides.wrap(stress, launch=launch)

    @property
    def fields(self) -> SandFields:
        """Return the fields as a kernel struct."""
        components = [
            c
            for f in (self.share, self.mass, self.inverse, self.start)
            for c in three_components(f)
        ]
        return SandFields(
            *[self.flags, self.drive, self.stiff, self.fraction, self.spans, *components]
        )
