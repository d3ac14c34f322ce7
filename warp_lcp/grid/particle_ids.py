"""Ids and times of birth of particles.

Ids are 0, 1, 2, ... in the order in which particles come into being, and are never used again.
Those of one event, such as the inflow of a step, have the order of their cells in the whole
domain, and within a cell the order of the process that adds them. So they do not depend on the
number of ranks. Ids grow with time: a table with one row an event, its first id and its time, gives
the age of every particle, and a step does nothing for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_lcp.grid.grid_part import GridPart
    from warp_lcp.grid.particles import Particles
    from warp_lcp.grid.staggered import StaggeredGrid

NO_ID = -1  # of a particle that has not got its id yet
ID, FIRST_IDS, BIRTH_TIMES = "id", "birth_ids", "birth_times"  # arrays of a state


def pack_ids(ids: np.ndarray) -> np.ndarray:
    """Return ids as a column of particles, float32 of shape (n, 3).

    The first eight bytes of a row are the id. Columns are copied, sorted and sent without
    arithmetic, so any bits survive.

    >>> unpack_ids(pack_ids(np.array([0, -1, 2**62 + 5]))).tolist()
    [0, -1, 4611686018427387909]
    """
    words = np.zeros((len(ids), 3), dtype=np.int32)
    words[:, :2] = np.ascontiguousarray(ids, dtype=np.int64).view(np.int32).reshape(-1, 2)
    return words.view(np.float32)


def unpack_ids(column: np.ndarray) -> np.ndarray:
    """Return the ids of `pack_ids`, int64, shape (n,)."""
    words = np.ascontiguousarray(column, dtype=np.float32).view(np.int32)
    return np.ascontiguousarray(words[:, :2]).view(np.int64).reshape(-1)


class ParticleIds:
    """Ids that have been given, and when.

    On ranks all have the same values.

    Attributes:
        next: the next id, which is the number of ids given.
        first: first id of each event, ascending.
        times: time of each event [s].
    """

    def __init__(self) -> None:
        self.next = 0
        self.first: list[int] = []
        self.times: list[float] = []

    def give(
        self,
        particles: Particles,
        begin: int,
        part: GridPart,
        time: float,
        cells: np.ndarray | None = None,
    ) -> None:
        """Give the next ids to the particles from an index on; collective.

        On ranks this takes one gather. A rank sends two numbers for each run of cells along x that
        hold new particles: the first cell and the number of particles.

        Args:
            particles: of this process, without ghosts.
            begin: index of its first new particle.
            part: part of the grid that this process works on.
            time: time of birth [s].
            cells: number of the cell of each new particle; None if they lie in the order of the
                cells on a single process.
        """
        new = particles.count - begin
        offsets, total = np.arange(new), new
        if cells is not None:
            order = np.argsort(cells, kind="stable")
            offsets[order], total = _offsets(cells[order], part)
        if new:
            particles.set_ids(begin, self.next + offsets)
        if total:
            self.first.append(self.next)
            self.times.append(time)
            self.next += total

    def ages(self, ids: np.ndarray, time: float) -> np.ndarray:
        """Return the ages of particles at a time [s], float32, shape (n,); NaN without an id."""
        event = np.searchsorted(np.array(self.first, dtype=np.int64), ids, side="right")
        born = np.array([np.nan, *self.times])[event]  # events count from 1; 0: before the first id
        return np.asarray(time - born, dtype=np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays that `restore` needs: the same on all ranks.

        `birth_ids` int64 (events + 1,), the last entry is the next id; `birth_times` float64
        (events,) [s].
        """
        return {
            FIRST_IDS: np.array([*self.first, self.next], dtype=np.int64),
            BIRTH_TIMES: np.array(self.times, dtype=np.float64),
        }

    def restore(self, state: Mapping[str, np.ndarray], ids: Sequence[np.ndarray] = ()) -> None:
        """Continue from the arrays of `state`.

        Args:
            state: the arrays, read from a file.
            ids: ids of particles, which must have been given.

        Raises:
            ValueError: they are no such arrays, or ids have not been given.
        """
        first, times = (np.asarray(state.get(name)) for name in (FIRST_IDS, BIRTH_TIMES))
        if (
            (first.dtype, times.dtype) != (np.dtype(np.int64), np.dtype(np.float64))
            or (first.ndim, times.ndim) != (1, 1)
            or len(first) != len(times) + 1
            or first[0] != 0
            or (np.diff(first) <= 0).any()
            or not np.isfinite(times).all()
        ):
            raise ValueError(f"the state's {FIRST_IDS} and {BIRTH_TIMES} are no table of births")
        for own in ids:
            if len(own) and not 0 <= own.min() <= own.max() < first[-1]:
                raise ValueError(f"the state's {ID} has ids that have not been given")
        *self.first, self.next = first.tolist()
        self.times = times.tolist()


def cell_numbers(grid: StaggeredGrid, position: np.ndarray) -> np.ndarray:
    """Return the number of the cell of positions [m] in the whole domain, int64, shape (n,).

    Cell (i, j, k) has the number (k n_y + j) n_x + i.
    """
    nx, ny, _ = counts = np.array(grid.domain_counts)
    cells = np.floor(np.nan_to_num(np.asarray(position, dtype=np.float64)) / grid.spacing)
    i, j, k = np.clip(cells, 0, counts - 1).astype(np.int64).T
    return np.asarray((k * ny + j) * nx + i)


def _offsets(cells: np.ndarray, part: GridPart) -> tuple[np.ndarray, int]:
    """Return the place of each new particle among those of all processes; collective.

    Places count in the order of the cells; a run of consecutive cells belongs to one process.

    Args:
        cells: cells of this process's new particles, ascending.
        part: part of the grid that it works on.

    Returns:
        The places, shape (n,), and the number of new particles of all processes.
    """
    begins = np.flatnonzero(np.diff(cells, prepend=-2) > 1)
    counts = np.diff(np.append(begins, len(cells)))
    collected = part.ranks.collect(np.stack([cells[begins], counts]))
    runs = np.concatenate(collected, axis=1)
    order = np.argsort(runs[0], kind="stable")
    before = np.empty(len(order), dtype=np.int64)
    before[order] = np.cumsum(runs[1][order]) - runs[1][order]
    own = sum(run.shape[1] for run in collected[: part.ranks.rank])
    shift = before[own : own + len(counts)] - begins
    return np.arange(len(cells)) + np.repeat(shift, counts), int(runs[1].sum())
