"""Results of a stress solve: velocity, wall contact and log values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.granular.cut_walls import cut_kind
from warp_lcp.granular.report_kernels import contact_kernel, report_pass, solved_velocity_kernel
from warp_lcp.granular.stress import Stress
from warp_lcp.grid.staggered import Window
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.material.boundary_kernels import HELD, RELEASED
from warp_lcp.material.particle_log import Row


class SandReport:
    """Velocity, wall contact and log values after a stress solve.

    Args:
        stress: the stresses.

    Attributes:
        ratio: ratio of each cell's friction to its bound, float32.
        contact: uint8: HELD in cells of sand with pressure, RELEASED without pressure, 0 elsewhere.
        known: int8, 1 on each component's faces that the stresses act on, -1 inside solids, 0
            elsewhere.
    """

    def __init__(self, stress: Stress) -> None:
        grid, self.stress = stress.packing.grid, stress
        self.ratio, self.contact, self.known = (
            grid.field(),
            grid.field(wp.uint8),
            grid.faces(wp.int8),
        )
        cut, stored = stress.packing.cut, Window((0, 0, 0), grid.shape, grid.device)
        self._report = WindowReduction(
            report_pass(grid.dimension, stress.rate, cut_kind(cut)), grid, stored
        )
        self._taking, self._reporting = (
            LaunchGraph(grid.device, record)
            for record in (self._launch_taking, self._launch_report)
        )
        # With solids that cut cells, no face inside a solid is left unknown.
        self._base = stress.packing.base if cut is None else grid.field(wp.int8)

    def write_outcome(self, velocity: Sequence[wp.array]) -> None:
        """Write the velocity after the stresses [m/s], `known` and `contact`; collective."""
        self._taking.run(velocity, variant=tuple(field.ptr for field in velocity))
        packing = self.stress.packing
        packing.grid.part.fill(
            *velocity, *self.known, self.contact, packing.kind, self.stress.now[0]
        )

    def _launch_taking(self, velocity: Sequence[wp.array]) -> None:
        """Launch the copy of velocities, and the contact of cells with sand."""
        stress, packing = self.stress, self.stress.packing
        for axis, field in enumerate(velocity):
            fields = [
                self._base,
                packing.inverse[axis],
                stress.checked.u[axis],
                field,
                self.known[axis],
            ]
            packing.grid.everywhere.launch(solved_velocity_kernel, [axis, *fields])
        inputs = [wp.uint8(HELD), wp.uint8(RELEASED), packing.flags, stress.now, self.contact]
        packing.grid.domain.launch(contact_kernel, inputs)

    def measure(self) -> None:
        """Launch the computation of the log values, which `report` returns."""
        self._reporting.run()
        self._report.changed()

    def report(self, mass: float) -> Row:
        """Return log values of the last solve, after `measure`; collective.

        yielded: fraction of the cells with shear stress whose friction is at its bound;
        dissipation: energy dissipated by friction, never negative except for the solve's residual
        [J; J/m in 2-D]; predicted_excess: largest amount by which a cell's fraction would exceed 1
        after the step.

        Args:
            mass: mass of a full cell [kg; kg/m in 2-D].
        """
        cells, yielded, taken, most = self._read_sums()
        return {
            "yielded": yielded / max(cells, 1.0),
            "dissipation": taken * mass,
            "predicted_excess": most,
        }

    def _launch_report(self) -> None:
        """Launch the sums of the log values over all cells."""
        stress, p = self.stress, self.stress.packing
        self._report.launch(
            p.counted,
            p.fields,
            stress.checked.fields,
            now=stress.now,
            numbers=stress.numbers,
            ratio=self.ratio,
        )

    def _read_sums(self) -> list[float]:
        """Return the cells with shear, those yielding, the dissipation, the excess.

        The first two are counts; the excess is the largest one.
        """
        part = self.stress.packing.grid.part
        part.fill(self.ratio)
        every = part.ranks.gather(np.array(self._report.read()))
        return [*every[:, :3].sum(axis=0).tolist(), float(every[:, 3].max())]
