"""How near a run is to its reference: bounds, by how much they are missed, and how sure the reference itself is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from warp_lcp.run.trial import Trial


@dataclass(frozen=True)
class Bounds:
    """The largest differences from a reference run.

    Args:
        distance: share of the mass that is elsewhere.
        volume: in the growth of a liquid's volume, or in how densely sand is packed.
    """

    distance: float
    volume: float

    def miss(self, own: Trial, reference: Trial) -> float:
        """Return how many times its bound a run's larger difference is: at most 1 within both."""
        return max(own.distance(reference) / self.distance, own.volume_error(reference) / self.volume)

    def beside(self, noise: Bounds) -> Bounds:
        """Return the bounds of what is measured where a difference and a noise, which know nothing of each other, add up.

        Their squares do: a run that lies a bound from the mean of runs as good as the reference lies so far from one of them.
        """
        return Bounds(math.hypot(self.distance, noise.distance), math.hypot(self.volume, noise.volume))


def spread_of(references: Sequence[Trial]) -> Bounds:
    """Return the largest differences between runs that are as good as each other, 0 of a single one.

    Nothing can be shown to be nearer to one of them.
    """
    pairs = list(itertools.combinations(references, 2))
    distance, volume = (max((of(b, a) for a, b in pairs), default=0.0) for of in (Trial.distance, Trial.volume_error))
    return Bounds(distance, volume)
