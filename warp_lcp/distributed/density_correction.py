"""Particles of several ranks that crowd: they are told by all, and moved apart by one LCP of all."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.distributed.grid_poisson import DistributedGridPoisson
from warp_lcp.distributed.particles import SharedParticles
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import DirtyRegion, Window
from warp_lcp.grid.tally import WindowTally
from warp_lcp.material.density_correction import CROWD, DensityCorrection, DensityMonitor
from warp_lcp.rows.program import LaunchGraph
from warp_lcp.rows.vectors import convert


class SharedDensityMonitor(DensityMonitor):
    """How much of the material of all ranks is in over-full cells; `measure` and `found` are collective.

    Args:
        part: where this rank works.
        settings: as of `DensityMonitor`, the part's grid among them.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        super().__init__(*settings, **more)
        self.part, self._trail = part, DirtyRegion(part.owned)
        self._crowd = WindowTally(CROWD, self.grid, part.owned)
        self._known: tuple[float, float] | None = None

    def measure(self, density: wp.array | None, particles: Particles, window: Window) -> None:
        """Look at the material as it is."""
        super().measure(density, particles, window)
        self._known = None

    def _find(self, density: wp.array, particles: Particles, window: Window) -> None:
        assert isinstance(particles, SharedParticles), "particles of ranks"
        particles.look_around()
        super()._find(density, particles, window)
        particles.drop_ghosts()
        self.part.fill(density)

    def found(self) -> tuple[float, float]:
        """Return which share of the material is beyond what cells may hold, and the largest density."""
        if self._known is None:
            self._known = super().found()
        return self._known

    def _read(self) -> list[float]:
        above, held, densest = super()._read()
        return [*self.part.ranks.sum(np.array([above, held])).tolist(), self.part.ranks.max(densest)]


class SharedDensityCorrection(DensityCorrection):
    """What moves particles of several ranks apart; `apply` is collective.

    Args:
        part: where this rank works.
        settings: as of `DensityCorrection`, the part's grid among them.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        super().__init__(*settings, **more)
        self.part, self._solved = part, part.owned
        at_once = part.grid.device.is_cuda  # ranks exchange halos through the host
        self._preparation.at_once = self._displacing.at_once = at_once
        self._boxing = LaunchGraph(part.grid.device, self._copy_to_boxes, at_once=at_once)
        self._boxes: list[Any] = [None if f is None else part.box_like(f) for f in self._fields]
        self._cells, self._rhs, self._guess, _, _ = self._boxes

    @property
    def _fields(self) -> list[Any]:
        return [self._kind, self._b, self.x, self._lower, self._shift]

    def _gather(self, particles: Particles) -> None:
        super()._gather(particles)
        assert isinstance(particles, SharedParticles), "particles of ranks"
        particles.look_around()

    def _release(self, particles: Particles) -> None:
        assert isinstance(particles, SharedParticles), "particles of ranks"
        particles.drop_ghosts()

    def _find_density(self, particles: Particles, window: Window) -> None:
        super()._find_density(particles, window)
        self.part.fill(self.density)

    def _join(self) -> None:
        self.part.fill(self._inside)

    def _counts(self, full: float, densest: float) -> tuple[int, float]:
        return int(self.part.ranks.sum(full)), float(self.part.ranks.max(densest))

    def _make_problem(self) -> wl.LCP:
        faces = {}
        for axis, field in zip("xyz", self.boundary.open, strict=False):
            face = faces[f"face_{axis}"] = self.part.box_like(field)
            self.part.copy_to_box(field, face)
        *_, lower, shift = self._boxes
        cells = self._cells.numpy()[1:-1, 1:-1, 1:-1]
        self._operator = DistributedGridPoisson(self.part.decomposition, cells, shift=shift, device=self.grid.device, **faces)
        self._faces = faces
        return wl.LCP(self._operator, self._rhs, 0.0 if lower is None else lower, np.inf)

    def _solve(self, over_full: int) -> wl.SolveResult:
        self._boxing.run()
        if self.boundary.moves and self._problem is not None:
            for field, face in zip(self.boundary.open, self._faces.values(), strict=True):
                self.part.copy_to_box(field, face)
        return super()._solve(over_full)

    def _copy_to_boxes(self) -> None:
        for field, box in zip(self._fields, self._boxes, strict=True):
            if box is not None:
                self.part.copy_to_box(field, box)

    def _take(self, x: wp.array) -> None:
        if x.dtype is not wp.float64:
            convert(x.flatten(), self._guess.flatten())
            x = self._guess
        self.part.take_box(self.x, x.reshape(self._rhs.shape))
        self.part.fill(self.x, self._kind)
