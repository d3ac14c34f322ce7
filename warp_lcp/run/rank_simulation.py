"""Simulation on ranks for the run loop: an error on one rank is raised on all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from warp_lcp.distributed.collective import Collective, RankFailed
from warp_lcp.run.log import Value
from warp_lcp.simulation import (
    Cells,
    HasEvents,
    HasPieces,
    HasStages,
    HasTables,
    NoStopwatch,
    Part,
    SimulationFailed,
    StepFailed,
    Stopwatch,
)

Corners = tuple[tuple[int, int, int], tuple[int, int, int]]


class RankSimulation:
    """A rank's part of a simulation: an error on one rank is raised on all.

    Args:
        simulation: simulation of this rank at the start of the run.
        collective: collective operations of the ranks.

    Attributes:
        time: time of the simulation [s].
        step_count: number of steps.
    """

    def __init__(self, simulation: HasPieces, collective: Collective) -> None:
        self._simulation, self._collective = simulation, collective
        self.time, self.step_count = simulation.time, simulation.step_count
        self._watch: Stopwatch = NoStopwatch()

    @property
    def watch(self) -> Stopwatch:
        """Profile of the stages."""
        return self._watch

    @watch.setter
    def watch(self, watch: Stopwatch) -> None:
        self._watch = watch
        if isinstance(self._simulation, HasStages):
            self._simulation.watch = watch

    @property
    def measured(self) -> Mapping[str, Mapping[str, Value]]:
        """The last step's row of each table."""
        return self._simulation.measured if isinstance(self._simulation, HasTables) else {}

    def tables(self) -> Mapping[str, tuple[str, ...]]:
        """Return the columns of each table."""
        return self._simulation.tables() if isinstance(self._simulation, HasTables) else {}

    def stable_dt(self) -> float:
        """Return the largest time step [s] that all ranks allow."""
        with self._collective.together():
            mine = self._simulation.stable_dt()
        return float(self._collective.share(mine))

    def events(self, until: float) -> list[float]:
        """Return the times of starts and stops, up to `until` [s]; equal on all ranks."""
        return self._simulation.events(until) if isinstance(self._simulation, HasEvents) else []

    def step(self, dt: float) -> dict[str, Value]:
        """Advance by dt [s] and return a row of the log.

        Raises:
            StepFailed: the solve missed its criteria on all ranks.
            SimulationFailed: the run cannot continue.
        """
        try:
            with self._collective.together():
                row = self._simulation.step(dt)
        except RankFailed as error:
            raise self._collective.local_exception(SimulationFailed(str(error))) from error
        except StepFailed as error:
            # The other ranks have continued: there is no state to retry from.
            if len(self._collective.failed) < self._collective.ranks.size:
                raise SimulationFailed(f"{error} (but not on all ranks)") from error
            raise
        self.time, self.step_count = self._simulation.time, self._simulation.step_count
        return row

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns."""
        return self._simulation.columns()

    def frame(self) -> list[Part]:
        """Return this rank's parts of a frame, with their position in the grid."""
        with self._collective.together():
            return [
                replace(part, box=part.box or self._box) if isinstance(part, Cells) else part
                for part in self._simulation.frame()
            ]

    def state(self) -> dict[str, np.ndarray]:
        """Return this rank's part of the state."""
        with self._collective.together():
            return self._simulation.state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a state, given as its only part."""
        self._simulation.restore_pieces([state])
        self.time, self.step_count = self._simulation.time, self._simulation.step_count

    def notes(self) -> list[str]:
        """Return remarks for the start of a run."""
        return self._simulation.notes()

    @cached_property
    def _box(self) -> Corners:
        """The box of the simulation's grid; distributed parts have boxes of their own."""
        (x0, y0, z0), (x1, y1, z1) = self._simulation.state()["box"].tolist()
        return (x0, y0, z0), (x1, y1, z1)
