"""What a solve of the stresses leaves: the velocity, what holds sand to walls, and figures for the log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.granular.report_kernels import contact_kernel, report_pass, take_kernel
from warp_lcp.granular.stress import Stress
from warp_lcp.grid.staggered import Window
from warp_lcp.grid.tally import WindowTally
from warp_lcp.material.boundary_kernels import HELD, RELEASED
from warp_lcp.material.particle_log import Row
from warp_lcp.rows.program import LaunchGraph


class SandReport:
    """Takes over what `Stress.checked` holds after a solve.

    Args:
        stress: the stresses.

    Attributes:
        ratio: of each cell's friction to its bound, float32.
        contact: uint8 of HELD where sand has pressure, RELEASED where it has none, 0 elsewhere.
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
        self._report = WindowTally(
            report_pass(grid.dimension, stress.rate, cut is not None), grid, stored
        )
        self._taking, self._reporting = (
            LaunchGraph(grid.device, record)
            for record in (self._launch_taking, self._launch_report)
        )
        # no face inside a solid that cuts cells is left unknown
        self._base = stress.packing.base if cut is None else grid.field(wp.int8)

    def take(self, velocity: Sequence[wp.array]) -> None:
        """Give the faces that stresses act on the velocity that they leave [m/s], and find `known` and `contact`; collective."""
        self._taking.run(velocity, variant=tuple(field.ptr for field in velocity))
        packing = self.stress.packing
        packing.grid.part.fill(
            *velocity, *self.known, self.contact, packing.kind, self.stress.now[0]
        )

    def _launch_taking(self, velocity: Sequence[wp.array]) -> None:
        stress, packing = self.stress, self.stress.packing
        for axis, field in enumerate(velocity):
            fields = [
                self._base,
                packing.inverse[axis],
                stress.checked.u[axis],
                field,
                self.known[axis],
            ]
            packing.grid.everywhere.launch(take_kernel, [axis, *fields])
        inputs = [wp.uint8(HELD), wp.uint8(RELEASED), packing.flags, stress.now, self.contact]
        packing.grid.domain.launch(contact_kernel, inputs)

    def measure(self) -> None:
        """Launch what finds the figures of the last solve, which `report` returns."""
        self._reporting.run()
        self._report.changed()

    def report(self, mass: float) -> Row:
        """Return figures of the last solve, after `measure`; collective.

        yielded: share of the cells that carry shear whose friction is at its bound; dissipation:
        what friction takes, never negative but for the solve's residual [J; J/m in 2-D];
        predicted_excess: by how much a cell's fraction would exceed 1 after the step, at most.

        Args:
            mass: of a full cell [kg; kg/m in 2-D].
        """
        cells, yielded, taken, most = self._found()
        return {
            "yielded": yielded / max(cells, 1.0),
            "dissipation": taken * mass,
            "predicted_excess": most,
        }

    def _launch_report(self) -> None:
        stress, p = self.stress, self.stress.packing
        self._report.take(
            p.counted,
            p.fields,
            stress.checked.fields,
            now=stress.now,
            numbers=stress.numbers,
            ratio=self.ratio,
        )

    def _found(self) -> list[float]:
        """Return how many cells carry shear, how many have yielded, what friction takes and the largest excess."""
        part = self.stress.packing.grid.part
        part.fill(self.ratio)
        every = part.ranks.gather(np.array(self._report.read()))
        return [*every[:, :3].sum(axis=0).tolist(), float(every[:, 3].max())]
