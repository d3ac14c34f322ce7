"""Multigrid where the strong direction turns from place to place: a hierarchy for each way in which cells are coupled."""

import functools
import math
from dataclasses import replace
from functools import cached_property
from typing import Any, no_type_check

import numpy as np
import warp as wp

from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.hierarchy import Hierarchy
from warp_lcp.operators.stencil import Stencil
from warp_lcp.rows import Bound
from warp_lcp.rows.program import Program


@no_type_check
@wp.func
def first_cell(sample: int, samples: int, blocks: int, edge: int):
    """First cell, from 1, of a sample's block; samples are spread evenly over the blocks."""
    return sample * blocks / samples * edge + 1


@no_type_check
@functools.cache
def sample_kernel(real: Any) -> Any:
    """Return the kernel for weights of this type, a thread a sampled block."""
    field = wp.array3d(dtype=real)

    @wp.func
    def largest(w: field, k0: int, j0: int, i0: int, edges: wp.vec3i):
        """The largest of a block's weights."""
        most = float(0.0)
        for k in range(k0, k0 + edges[0]):
            for j in range(j0, j0 + edges[1]):
                for i in range(i0, i0 + edges[2]):
                    most = wp.max(most, float(w[k, j, i]))
        return most

    @wp.func
    def mean_logarithm(w: field, k0: int, j0: int, i0: int, edges: wp.vec3i, bottom: float):
        """Mean logarithm of a block's weights that are not 0, those below `bottom` taken for it; NaN if most are 0: few tell nothing."""
        total, count = float(0.0), float(0.0)
        for k in range(k0, k0 + edges[0]):
            for j in range(j0, j0 + edges[1]):
                for i in range(i0, i0 + edges[2]):
                    v = float(w[k, j, i])
                    if v > 0.0:
                        total += wp.log(wp.max(v, bottom))
                        count += 1.0
        if 2.0 * count < float(edges[0] * edges[1] * edges[2]):
            total = wp.nan
        return total / count

    @wp.kernel(enable_backward=False, module=f"warp_lcp.turning.{real.__name__}")
    def sample(
        wx: field, wy: field, wz: field, samples: wp.vec3i, blocks: wp.vec3i, edges: wp.vec3i, least: float, out: wp.array(dtype=wp.vec3)
    ):
        """Write a block's mean logarithms along x, y, z; weights below `least` of its largest count as that."""
        c, b, a = wp.tid()
        k0 = first_cell(c, samples[0], blocks[0], edges[0])
        j0 = first_cell(b, samples[1], blocks[1], edges[1])
        i0 = first_cell(a, samples[2], blocks[2], edges[2])
        most = wp.max(wp.max(largest(wx, k0, j0, i0, edges), largest(wy, k0, j0, i0, edges)), largest(wz, k0, j0, i0, edges))
        x = mean_logarithm(wx, k0, j0, i0, edges, least * most)
        y = mean_logarithm(wy, k0, j0, i0, edges, least * most)
        z = mean_logarithm(wz, k0, j0, i0, edges, least * most)
        out[(c * samples[1] + b) * samples[2] + a] = wp.vec3(x, y, z)

    return sample


Strength = list[float]  # mean weights along x, y and z, in units of the largest

TURN = 10.0  # ratios of weights that differ by this factor between places, or from the mean weights', ask for a hierarchy of their own
SHARE = 0.01  # of the sampled blocks that must do so
LEAST = 1e-6  # of a block's largest weight: what smaller ones count as
EDGES = {2: 8, 3: 4}  # cells of a block along each long axis: 64 faces an axis, whose mean noise does not turn
SAMPLES = {2: 24, 3: 8}  # the most blocks that are sampled along each axis: 2 ms in all, whatever the grid


class TurningHierarchy(Hierarchy):
    """`Hierarchy` and companions that coarsen other axes first; cycles visit them one after another, forth and back.

    Point sweeps smooth along strong couplings only, so levels must coarsen there; where the strong axis differs from place to place no
    order of coarsening suits all of them. Each hierarchy deals with the places that it suits, and
    each cycle starts from what the one before has left, so that they share the finest level and need no residuals between them.

    Args:
        strengths: of each companion.
    """

    def __init__(self, stencil: Stencil, real: Any, strengths: list[Strength], **options: Any) -> None:
        settings = options.pop("settings", None) or CycleSettings()
        fewer = math.prod(stencil.padding.counts) - 1  # a launch of all levels starts from x = 0: the finest one stays out of it
        cpu, cuda = (min(n, fewer) for n in (settings.one_launch_cpu, settings.one_launch_cuda))
        settings = replace(settings, one_launch_cpu=cpu, one_launch_cuda=cuda)
        super().__init__(stencil, real, **options, settings=settings)
        options["settings"] = replace(settings, gamma=1)  # W-cycles save a step in ten and cost two to four times as much
        self.companions = [Hierarchy(stencil, real, **options, strength=strength, finest=self.finest) for strength in strengths]
        self._marks = wp.zeros_like(self.finest.changed)

    @property
    def nbytes(self) -> int:
        """Bytes that the levels hold, the finest one once; shared weights not counted."""
        finest = {id(v): v.capacity for v in (self.finest.x, self.finest.b, self.finest.t, self.finest.lower, self.finest.upper)}
        return super().nbytes + sum(c.nbytes - sum(finest.values()) for c in self.companions)

    def refresh(self) -> None:
        """Take the operator's rows and weights again."""
        super().refresh()
        for companion in getattr(self, "companions", ()):
            companion.refresh()

    def rebuild(self) -> None:
        """Coarsen from the finest diagonal down."""
        self.finest.changed.fill_(1)
        self.rebuild_changed()

    def rebuild_changed(self) -> None:
        """Coarsen what the finest level's marked rows change; the last hierarchy clears the marks."""
        wp.copy(self._marks, self.finest.changed)
        for part in (self, *self.companions):
            wp.copy(self.finest.changed, self._marks)
            part._coarsening.run()

    @cached_property
    def cycle(self) -> Program:
        """One cycle on each hierarchy, forth and back: symmetric."""
        return self._one_by_one([*self.companions, self, *self.companions[::-1]], projected=False)

    @cached_property
    def monotone_cycle(self) -> Program:
        """One projected cycle on each hierarchy."""
        return self._one_by_one([*self.companions, self], projected=True)

    @cached_property
    def open_cycle(self) -> Program | None:
        """The linear cycle without its last leg."""
        if super().open_cycle is None:
            return None
        program = self._one_by_one([*self.companions, self, *self.companions[:0:-1]], projected=False)
        self.companions[0]._descend(0, program, projected=False, from_zero=False, whole=False)
        return program

    def last_leg(self) -> tuple[Bound, ...]:
        """Return what the last leg of a linear cycle takes."""
        return self.companions[0].last_leg()

    def _one_by_one(self, parts: list[Hierarchy], *, projected: bool) -> Program:
        """Return a cycle on each part, the first from x = 0."""
        program = Program(self.device)
        for place, part in enumerate(parts):
            program.extend(part._descent(0, projected=projected, from_zero=place == 0))
        return program


def make_hierarchy(stencil: Stencil, real: Any, **options: Any) -> Hierarchy:
    """Return the hierarchy of a stencil, of all processes where it is shared; options as of `Hierarchy`."""
    if stencil.ghosts is not None:
        return stencil.ghosts.hierarchy(stencil, real, **options)
    strengths = turns(stencil)
    return TurningHierarchy(stencil, real, strengths, **options) if strengths else Hierarchy(stencil, real, **options)


def turns(stencil: Stencil) -> list[Strength]:
    """Return the ways in which cells are coupled that the mean weights do not tell; none where the strong axes are the same everywhere.

    Blocks are sampled. The mean logarithm of 64 faces knows neither random coefficients, nor surfaces and cut cells, which are few in a
    block, from equal ones; where a block's ratios of weights along the axes differ from the median block's by `TURN`, the direction turns.
    """
    if stencil.weights is None:
        return []
    logs = _sampled(stencil)
    centered = logs - logs.mean(axis=1, keepdims=True)
    if len(logs) == 0 or (_mismatch(centered, np.median(centered, axis=0)) > math.log(TURN)).mean() < SHARE:
        return []
    long = _long(stencil)
    relative = logs - logs.max(axis=1, keepdims=True)
    ways, way_of = np.unique(relative > -math.log(TURN), axis=0, return_inverse=True)
    mean, found = np.log(np.maximum(np.array(stencil.mean_weights)[long], 1e-300)), []
    for way in range(len(ways)):
        members = relative[way_of == way]
        if len(members) < SHARE * len(relative):
            continue
        typical = np.median(members, axis=0)
        if _mismatch(typical[None], mean)[0] > math.log(TURN):
            strength = np.full(3, LEAST)
            strength[long] = np.exp(typical)
            found.append(strength.tolist())
    return found


def _mismatch(logs: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return by how much the ratios of rows of weights differ from others, as a logarithm."""
    return np.ptp(logs - other, axis=1)


def _long(stencil: Stencil) -> list[int]:
    """Return the axes of more than one cell, 0, 1, 2 = x, y, z."""
    return [axis for axis, n in enumerate(reversed(stencil.padding.counts)) if n > 1]


def _sampled(stencil: Stencil) -> np.ndarray:
    """Return the mean logarithms of the weights along the long axes, a row a block that has open faces along all of them."""
    counts, long, device = stencil.padding.counts, _long(stencil), stencil.device
    dimension = max(len(long), 2)
    edges = [min(n, EDGES[dimension]) for n in counts]
    blocks = [n // edge for n, edge in zip(counts, edges, strict=True)]
    samples = [min(n, SAMPLES[dimension]) for n in blocks]
    assert stencil.weights is not None
    grids = [w.reshape(stencil.padding.shape) for w in stencil.weights]
    out = wp.empty(math.prod(samples), dtype=wp.vec3, device=device)
    inputs = [*grids, wp.vec3i(*samples), wp.vec3i(*blocks), wp.vec3i(*edges), LEAST, out]
    wp.launch(sample_kernel(grids[0].dtype), samples, inputs, device=device)
    logs = out.numpy()[:, long].astype(np.float64)
    return logs[np.isfinite(logs).all(axis=1)] if len(long) > 1 else logs[:0]
