"""Multiple semicoarsening, for anisotropy whose direction varies in space.

There is a hierarchy for each direction of strong coupling.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Unpack

import numpy as np
import warp as wp

from warp_lcp.kernels import Rows
from warp_lcp.kernels.types import DataType, DeviceArray
from warp_lcp.multigrid.cycle import CycleStage
from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.hierarchy import Hierarchy, HierarchyOptions
from warp_lcp.operators.padded_stencil import PaddedStencil
from warp_lcp.operators.sparse import GATHER

Strength = list[float]  # mean weights along x, y and z, in units of the largest

# Ratios of weights that differ by this factor between places, or from the mean weights', need a
# hierarchy of their own.
TURN = 10.0
SHARE = 0.01  # least share of the sampled blocks with such ratios
LEAST = 1e-6  # least weight that counts, relative to a block's largest
# Cells of a block along each long axis: 64 faces an axis, whose mean noise does not look like a
# change of direction.
EDGES = {2: 8, 3: 4}
# The most blocks that are sampled along each axis: 2 ms in all, whatever the grid.
SAMPLES = {2: 24, 3: 8}


class MultipleSemicoarsening(Hierarchy):
    """A `Hierarchy` and companions that coarsen other axes first.

    Cycles visit them one after another, forward and backward. Point sweeps smooth along strong
    couplings only, so levels must coarsen there; where the strong axis differs from place to place
    no order of coarsening suits all of them. Each hierarchy corrects the places that it suits, and
    each cycle starts from the result of the one before, so that they share the finest level and
    need no residuals between them.

    Args:
        strengths: of each companion.
    """

    def __init__(
        self,
        stencil: PaddedStencil,
        real: DataType,
        strengths: list[Strength],
        **options: Unpack[HierarchyOptions],
    ) -> None:
        settings = options.pop("settings", None) or CycleSettings()
        # A fused launch of all levels starts from x = 0, so the finest level must not be part of
        # it.
        fewer = math.prod(stencil.padding.counts) - 1
        settings = replace(
            settings,
            one_launch_cpu=min(settings.one_launch_cpu, fewer),
            one_launch_cuda=min(settings.one_launch_cuda, fewer),
            one_launch_cluster=min(settings.one_launch_cluster, fewer),
        )
        self.companions: list[Hierarchy] = []  # `refresh` of the base comes before theirs exist
        options["settings"] = settings
        super().__init__(stencil, real, **options)
        # W-cycles save a step in ten and cost two to four times as much.
        options["settings"] = replace(settings, gamma=1)
        self.companions = [
            Hierarchy(stencil, real, **options | {"strength": strength, "finest": self.finest})
            for strength in strengths
        ]
        self._marks = wp.zeros_like(self.finest.changed)

    @property
    def nbytes(self) -> int:
        """Memory of the levels [bytes].

        The finest one counts once, shared weights not at all.
        """
        return super().nbytes + sum(c.nbytes - self.finest.nbytes for c in self.companions)

    def refresh(self) -> None:
        """Update the operator's rows and weights."""
        super().refresh()
        for companion in self.companions:
            companion.refresh()

    def rebuild_changed(self) -> None:
        """Coarsen what the finest level's marked rows change.

        The last hierarchy clears the marks.
        """
        wp.copy(self._marks, self.finest.changed)
        for part in (self, *self.companions):
            wp.copy(self.finest.changed, self._marks)
            part.rebuild_program.run()

    def _last_leg(self) -> tuple[CycleStage, ...]:
        """Return the stages of the last leg of a linear cycle."""
        return self.companions[0]._last_leg()

    def _stages(self, *, projected: bool) -> Iterator[CycleStage]:
        """Yield a cycle on each hierarchy, the first from x = 0.

        Linear cycles go forward and backward, which is symmetric.
        """
        parts = [*self.companions, self, *(() if projected else self.companions[::-1])]
        for place, part in enumerate(parts):
            yield from part.cycles[projected].stages(from_zero=place == 0)


def make_hierarchy(
    stencil: PaddedStencil, real: DataType, **options: Unpack[HierarchyOptions]
) -> Hierarchy:
    """Return the hierarchy of a stencil; options as of `Hierarchy`."""
    strengths = turns(stencil) if stencil.ghosts is None else []
    return (
        MultipleSemicoarsening(stencil, real, strengths, **options)
        if strengths
        else Hierarchy(stencil, real, **options)
    )


def turns(stencil: PaddedStencil) -> list[Strength]:
    """Return the strengths of coupling that the mean weights do not show.

    Empty where the strong axes are the same everywhere. Blocks are sampled. The mean logarithm of
    64 faces hardly depends on random coefficients, surfaces and cut cells, which are few in a
    block; where a block's ratios of weights along the axes differ from the median block's by
    `TURN`, the direction turns.

    The mismatch of two rows of weights w and v, over the axes a, is

        max_a log(w_a / v_a) - min_a log(w_a / v_a);

    it counts where it exceeds log TURN. At least the part SHARE of the sampled blocks must differ
    from the median block, and a group of that size from the mean weights.
    """
    if stencil.weights is None or stencil.pattern is not None:
        return []
    logs = _sampled(stencil)
    # Ratios of weights along the axes, as differences of logarithms.
    centered = logs - logs.mean(axis=1, keepdims=True)
    if (
        len(logs) == 0
        or (_mismatch(centered, np.median(centered, axis=0)) > math.log(TURN)).mean() < SHARE
    ):
        return []
    long = _long(stencil)
    relative = logs - logs.max(axis=1, keepdims=True)
    # Blocks are grouped by their strong axes: those within TURN of the strongest one.
    ways, way_of = np.unique(relative > -math.log(TURN), axis=0, return_inverse=True)
    mean, strengths = np.log(np.maximum(np.array(stencil.mean_weights)[long], 1e-300)), []
    for way in range(len(ways)):
        members = relative[way_of == way]
        if len(members) < SHARE * len(relative):
            continue
        # A group needs a hierarchy of its own if its ratios differ from those of the mean weights.
        typical = np.median(members, axis=0)
        if _mismatch(typical[None], mean)[0] > math.log(TURN):
            strength = np.full(3, LEAST)
            strength[long] = np.exp(typical)
            strengths.append(strength.tolist())
    return strengths


def _mismatch(logs: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return how much the ratios of rows of weights differ, as a logarithm."""
    return np.asarray(np.ptp(logs - other, axis=1))


def _long(stencil: PaddedStencil) -> list[int]:
    """Return the axes of more than one cell, 0, 1, 2 = x, y, z."""
    return [axis for axis, n in enumerate(reversed(stencil.padding.counts)) if n > 1]


def _sampled(stencil: PaddedStencil) -> np.ndarray:
    """Return the mean logarithms of the weights along the long axes.

    mean log w over the faces with w > 0 of a block, shape (blocks, axes). Smaller weights than
    LEAST times the block's largest count as that. Only blocks of which half of the faces are open
    along each of these axes have a row.
    """
    cells, long, device = stencil.padding.counts, _long(stencil), stencil.device
    dimension = max(len(long), 2)
    edges = [min(n, EDGES[dimension]) for n in cells]
    blocks = [n // edge for n, edge in zip(cells, edges, strict=True)]
    samples = [min(n, SAMPLES[dimension]) for n in blocks]
    shape, sides = stencil.padding.shape, (math.prod(samples), math.prod(edges))
    along = [
        # Samples are spread evenly over the blocks.
        (np.arange(m) * n // m * edge + 1)[:, None] + np.arange(edge)
        for m, n, edge in zip(samples, blocks, edges, strict=True)
    ]
    places = np.ravel_multi_index(np.ix_(*(at.ravel() for at in along)), shape)
    places = places.reshape(
        [n for pair in zip(samples, edges, strict=True) for n in pair]
    ).transpose(0, 2, 4, 1, 3, 5)
    order = wp.array(places.ravel(), dtype=wp.int32, device=device)
    assert stencil.weights is not None
    # Indices: block, axis, face.
    faces = np.stack([_gathered(w, order).reshape(sides) for w in stencil.weights], axis=1)
    least = LEAST * faces.max(axis=(1, 2), keepdims=True)
    totals = np.log(np.where(faces > 0, np.maximum(faces, least), 1.0)).sum(axis=2)
    counts = np.count_nonzero(faces, axis=2)
    # Blocks with few open faces are not representative.
    counted = (2 * counts >= sides[1])[:, long].all(axis=1)
    return np.asarray(
        (totals / np.maximum(counts, 1))[counted][:, long] if len(long) > 1 else totals[:0, long]
    )


def _gathered(weights: DeviceArray, order: DeviceArray) -> np.ndarray:
    taken = wp.empty(order.size, dtype=weights.dtype, device=order.device)
    GATHER.bind(
        Rows.flat(order.size, order.device), source=weights, order=order, taken=taken
    ).launch()
    return np.asarray(taken.numpy().astype(np.float64))
