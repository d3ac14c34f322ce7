"""Boxes of cells of a grid; each process has one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

Triple = tuple[int, int, int]


@dataclass(frozen=True)
class CellBox:
    """Box of cells from `low` to `high` (exclusive) along x, y, z."""

    low: Triple
    high: Triple

    @classmethod
    def of(cls, low: Iterable[int], high: Iterable[int]) -> CellBox:
        """Return the box between two corners given as any sequences."""
        (a, b, c), (d, e, f) = low, high
        return cls((int(a), int(b), int(c)), (int(d), int(e), int(f)))

    @property
    def counts(self) -> Triple:
        """Number of cells along x, y, z; 0 if the box is empty."""
        nx, ny, nz = (max(h - l, 0) for l, h in zip(self.low, self.high, strict=True))
        return nx, ny, nz

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self.counts)

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """Slices of the box in an array (nz, ny, nx) of all cells."""
        x, y, z = (slice(l, h) for l, h in zip(self.low, self.high, strict=True))
        return z, y, x

    def grown(self, width: int) -> CellBox:
        """Return the box enlarged by a number of cells on all sides."""
        return CellBox.of((l - width for l in self.low), (h + width for h in self.high))

    def common(self, other: CellBox) -> CellBox:
        """Return the intersection with another box."""
        return CellBox.of(map(max, self.low, other.low), map(min, self.high, other.high))

    def moved(self, by: Sequence[int], sign: int = 1) -> CellBox:
        """Return the box shifted by a number of cells along x, y, z, or back."""
        return CellBox.of(
            *(
                [a + sign * b for a, b in zip(corner, by, strict=True)]
                for corner in (self.low, self.high)
            )
        )
