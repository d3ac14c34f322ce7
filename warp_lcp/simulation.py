"""Interface of a simulation to a run: steps, state, frames, errors, stages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import warp as wp

from warp_lcp.problem.result import SolveStatus

NOTHING = nullcontext()


class Stopwatch(Protocol):
    """Interface by which a run and its simulation time their stages."""

    def stage(self, name: str, *arrays: wp.array | None) -> AbstractContextManager[None]:
        """Return the context of a stage; the stages of a thread do not overlap.

        Args:
            name: of the stage, which may have several parts.
            arrays: arrays that it reads or writes.
        """

    def beside(self, name: str) -> AbstractContextManager[None]:
        """Return the context of work that another thread does at the same time."""

    def add_file_sizes(self, name: str, *files: Path) -> None:
        """Add the sizes of files to a stage."""


class NoStopwatch:
    """Stopwatch that measures nothing.

    It reads no clock and does not wait for the device.
    """

    def stage(self, name: str, *arrays: wp.array | None) -> AbstractContextManager[None]:
        """Return a context that does nothing."""
        return NOTHING

    def beside(self, name: str) -> AbstractContextManager[None]:
        """Return a context that does nothing."""
        return NOTHING

    def add_file_sizes(self, name: str, *files: Path) -> None:
        """Do nothing."""


class InputError(ValueError):
    """Invalid user input.

    The message names the input and says what is allowed; the command line ends with exit code 2.
    """


class StepFailed(RuntimeError):
    """The solve of a step missed its criteria.

    The state is as before the step, so a smaller dt may be tried.
    """


def missed_by_far(
    solve: str, status: SolveStatus, iterations: int, residual: str, advice: str
) -> StepFailed:
    """Return the exception for a solve that ended too far from its tolerance.

    Args:
        solve: name of the quantity that is solved for.
        status: status of the solve.
        iterations: number of iterations.
        residual: final residual, with its unit and the required one, in words.
        advice: settings that may help.
    """
    return StepFailed(
        f"the {solve} solve ended with {status.name} after {iterations} iterations at a "
        f"{residual}: {advice}"
    )


class SimulationFailed(RuntimeError):
    """The run cannot go on, for example because a field is not finite.

    The message names step, field and cell.
    """


@runtime_checkable
class HasTables(Protocol):
    """A simulation that fills tables of its own beside the log, a row a step.

    Attributes:
        measured: the last step's row of each table.
    """

    measured: Mapping[str, Mapping[str, float | int | str | None]]

    def tables(self) -> Mapping[str, tuple[str, ...]]:
        """Return the columns of each table by the name of its file.

        The first column is `step`.
        """


@dataclass(frozen=True)
class Points:
    """A frame of vertices.

    Args:
        name: first part of the names of its files.
        points: positions [m], shape (n, 3).
        fields: values at the points, shape (n,) or (n, 3) each.
    """

    name: str
    points: np.ndarray
    fields: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Cells:
    """A frame of equal axis-aligned cells.

    Args:
        name: first part of the names of its files.
        index: integer x, y, z of each cell, shape (n, 3); its low corner is at index * spacing.
        spacing: of the cells [m].
        dimension: 2 makes quadrilaterals in the plane z = 0, 3 makes voxels.
        fields: values of the cells, shape (n,) or (n, 3) each.
        counts: numbers of cells of the whole grid along x, y and z; its image has them in every
            frame.
        box: the part of the grid that these cells come from, if other ranks have the rest: its
            first cell and the one behind its last. An image then shows that part.
    """

    name: str
    index: np.ndarray
    spacing: float
    dimension: int
    fields: dict[str, np.ndarray] = field(default_factory=dict)
    counts: tuple[int, int, int] | None = None
    box: tuple[tuple[int, int, int], tuple[int, int, int]] | None = None


@dataclass(frozen=True)
class Surface:
    """A frame of a surface: triangles, in 2-D the segments of an outline.

    Args:
        name: first part of the names of its files.
        points: positions [m], shape (n, 3).
        corners: indices of points: of triangles, shape (m, 3), counterclockwise seen from outside,
            or of segments, shape (m, 2), with the inside on the left.
        fields: values at the points, shape (n,) or (n, 3) each.
    """

    name: str
    points: np.ndarray
    corners: np.ndarray
    fields: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Volume:
    """A frame of values at the centers of a 3-D grid's cells.

    Args:
        name: first part of the names of its files.
        values: float32, shape (nz, ny, nx); vectors (nz, ny, nx, 3) only in a `VolumeGroup`.
        spacing: of the cells [m].
        band: for a signed distance, < 0 inside: distance from the surface up to which it is known
            [m]. None for a density, >= 0.
        origin: numbers of cells (x, y, z) between the domain's low corner and the first cell.
    """

    name: str
    values: np.ndarray
    spacing: float
    band: float | None = None
    origin: tuple[int, int, int] = (0, 0, 0)


@dataclass(frozen=True)
class VolumeGroup:
    """A frame of several volumes in one file.

    Args:
        name: first part of the names of its files.
        volumes: values of one grid.
    """

    name: str
    volumes: tuple[Volume, ...]


Part = Points | Cells | Surface | Volume | VolumeGroup  # of a frame


class Simulation(Protocol):
    """A simulation in progress: state on a device and the rule for one step."""

    time: float  # [s]
    step_count: int

    def stable_dt(self) -> float:
        """Return the largest time step [s] that the scene's CFL number allows now.

        It is a function of the state alone, and not yet clipped to dt_min, dt_max or a frame's
        time.
        """

    def step(self, dt: float) -> dict[str, float | int | str | None]:
        """Advance by dt [s] and return a row of the log.

        Raises:
            StepFailed: the solve missed its criteria and the state is unchanged.
            SimulationFailed: the run cannot go on.
        """

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns that `step` fills, in order.

        They stand after `step`, `time` and `dt` and before `seconds`.
        """

    def frame(self) -> list[Part]:
        """Return the parts of a frame, as host arrays that no later step changes.

        The arrays are written while the simulation goes on.
        """

    def state(self) -> dict[str, np.ndarray]:
        """Return the state that `restore` needs to continue bit for bit on the CPU.

        Host arrays, without pickled objects.
        """

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from `state`.

        Raises:
            ValueError: the arrays do not belong to this scene.
        """

    def notes(self) -> list[str]:
        """Return warnings and facts for the start of a run.

        For example: a mesh lies outside the domain.
        """


@runtime_checkable
class HasEvents(Protocol):
    """Optional interface of a simulation with events at known times.

    Something starts or stops at these times. Steps end there where that takes no step much shorter
    than its neighbors. Other steps run across an event: the simulation must be right then too.
    """

    def events(self, until: float) -> list[float]:
        """Return the times [s] of events after now and up to `until` [s], in any order."""


@runtime_checkable
class HasStages(Protocol):
    """Optional interface of a simulation that times the stages of its step.

    It wraps the stages of its step in `with self.watch.stage(name, *arrays)`. A run that is
    profiled sets `watch` before the first step; until then it is a `NoStopwatch`.
    """

    watch: Stopwatch


@runtime_checkable
class HasRecordedProblems(Protocol):
    """Optional interface of a simulation that records the problems it solves.

    Until a run sets `record`, it is None and costs nothing. Then each step calls it before its
    solve, once an attempt, with the arrays of a file as `warp_lcp.recorded_problem` describes them.
    Problems that no method solves are recorded too.
    """

    record: Callable[[Mapping[str, np.ndarray]], object] | None


@runtime_checkable
class HasResampling(Protocol):
    """Optional interface of a simulation that can continue a state of another grid."""

    def resample(self, state: Mapping[str, np.ndarray]) -> list[str]:
        """Continue from a state that differs in `domain.resolution` alone.

        Returns:
            Messages about the change for the user.

        Raises:
            ValueError: the state does not belong to this scene on any grid, or cannot be brought to
                this one.
        """


@runtime_checkable
class HasPieces(Simulation, Protocol):
    """Optional interface of a simulation that is distributed over MPI ranks.

    It can also be resumed from a run on several ranks. On several ranks it is a rank's part:
    `stable_dt`, `step`, `frame`, `restore` (the state of one process) and `restore_pieces` are
    collective. Times, rows of the log and columns are those of the whole simulation, the same on
    all ranks, which also raise the same kind of error. `frame` returns the part of this rank, in
    coordinates of the whole domain. `state` returns this rank's part of the state; `box` in it, int
    (2, 3), has the first cell of the part and the one behind the last.
    """

    def restore_pieces(self, pieces: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Continue from the state parts of all ranks of a run.

        The number of those ranks may differ. An array is read when it is accessed.

        Raises:
            ValueError: the pieces do not belong to this scene.
        """
