"""Deterministic summation order for nearly sorted particles."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


def _none() -> np.ndarray:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class SummationOrder:
    """Sorted and unsorted particles of a list, by place.

    Args:
        places: of all particles when all were sorted.
        loose: indices whose particles were replaced since, ascending.
    """

    places: np.ndarray
    loose: np.ndarray = field(default_factory=_none)

    def changed(self, numbers: np.ndarray, before: int, count: int) -> SummationOrder:
        """Return the order after particles of some numbers were replaced.

        There are then `count` particles, where there were `before`.
        """
        loose = np.concatenate([self.loose, numbers, np.arange(before, count)])
        return SummationOrder(self.places, np.unique(loose[loose < count]))

    def runs(self, place: np.ndarray, count: int) -> np.ndarray:
        """Return begin and end of each sorted run of particles, shape (2 runs,).

        Args:
            place: of the particles as they are, and of others behind them that are in any order.
            count: particles without the others.
        """
        end = min(count, len(self.places))
        gaps, unsorted = (
            self.loose[self.loose < end],
            np.append(self.loose, np.arange(count, len(place))),
        )
        unsorted = unsorted[np.argsort(place[unsorted], kind="stable")]
        # Sorted particle before which each of them belongs.
        before = np.searchsorted(self.places[:end], place[unsorted], side="right")
        cuts = np.sort(np.concatenate([[0, end], before, gaps, gaps + 1]), kind="stable")
        held = cuts[1:] > cuts[:-1]
        held[held] = ~np.isin(cuts[:-1][held], gaps)
        begins, ends = (
            np.append(unsorted + last, cuts[last : len(cuts) - 1 + last][held]) for last in (0, 1)
        )
        order = np.argsort(np.append(before, cuts[:-1][held]), kind="stable")
        return np.stack([begins[order], ends[order]], axis=1).ravel()
