"""Runs on several MPI ranks: the same loop on each, whose decisions, failures and end are those of all."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from warp_lcp.distributed.meeting import Meeting, RankFailed
from warp_lcp.run.check import check_memory
from warp_lcp.run.checkpoint import PIECES
from warp_lcp.run.engine import Engine
from warp_lcp.run.folder import Continuation, RunRecord
from warp_lcp.run.log import Value
from warp_lcp.run.loop import run_in_folder
from warp_lcp.run.parallel_folder import ParallelRunFolder
from warp_lcp.run.profile import Profile
from warp_lcp.run.progress import Observer
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.table import Problem, SceneError, written
from warp_lcp.simulation import (
    Cells,
    DistributedSimulation,
    DistributedSimulator,
    NoStopwatch,
    Part,
    Profiled,
    Scheduled,
    Simulation,
    SimulationFailed,
    StepFailed,
    Stopwatch,
    simulators,
)

Corners = tuple[tuple[int, int, int], tuple[int, int, int]]


class AgreedSimulation:
    """A rank's part of a simulation as the run loop wants it: an error on one rank is one on all.

    Args:
        simulation: of this rank, where the run begins or goes on.
        meeting: of the ranks.

    Attributes:
        time: the simulation's [s].
        step_count: steps done.
    """

    def __init__(self, simulation: DistributedSimulation, meeting: Meeting) -> None:
        """Take over a simulation."""
        self._simulation, self._meeting = simulation, meeting
        self.time, self.step_count = simulation.time, simulation.step_count
        self._watch: Stopwatch = NoStopwatch()

    @property
    def watch(self) -> Stopwatch:
        """What the stages are measured with."""
        return self._watch

    @watch.setter
    def watch(self, watch: Stopwatch) -> None:
        self._watch = watch
        if isinstance(self._simulation, Profiled):
            self._simulation.watch = watch

    def stable_dt(self) -> float:
        """Return the largest time step [s] that all ranks allow."""
        with self._meeting.together():
            mine = self._simulation.stable_dt()
        return float(self._meeting.share(mine))

    def events(self, until: float) -> list[float]:
        """Return when something starts or stops, up to `until` [s]; all ranks know it."""
        return self._simulation.events(until) if isinstance(self._simulation, Scheduled) else []

    def step(self, dt: float) -> dict[str, Value]:
        """Advance by dt [s] and return a row of the log.

        Raises:
            StepFailed: the solve missed its criteria on all ranks.
            SimulationFailed: the run cannot go on.
        """
        try:
            with self._meeting.together():
                row = self._simulation.step(dt)
        except RankFailed as error:
            raise SimulationFailed(str(error)) from error
        except StepFailed as error:
            if len(self._meeting.failed) < self._meeting.ranks.size:  # the others have gone on: there is no state to try again from
                raise SimulationFailed(f"{error} (but not on all ranks)") from error
            raise
        self.time, self.step_count = self._simulation.time, self._simulation.step_count
        return row

    def columns(self) -> tuple[str, ...]:
        """Return the names of the log's columns."""
        return self._simulation.columns()

    def frame(self) -> list[Part]:
        """Return this rank's pieces of a frame; cells know which part of the grid they are from."""
        with self._meeting.together():
            return [replace(part, box=part.box or self._box) if isinstance(part, Cells) else part for part in self._simulation.frame()]

    def state(self) -> dict[str, np.ndarray]:
        """Return this rank's piece of the state."""
        with self._meeting.together():
            return self._simulation.piece_state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from the only piece of a state."""
        self._simulation.restore_pieces([state])
        self.time, self.step_count = self._simulation.time, self._simulation.step_count

    def notes(self) -> list[str]:
        """Return what is worth a line at the start of a run."""
        return self._simulation.notes()

    @cached_property
    def _box(self) -> Corners:
        (x0, y0, z0), (x1, y1, z1) = self._simulation.piece_state()["box"].tolist()
        return (x0, y0, z0), (x1, y1, z1)


def run_on_ranks(
    scene: Scene,
    out: Path,
    *,
    meeting: Meeting,
    device: str,
    observer: Observer,
    overrides: Sequence[dict[str, str]] = (),
    last_frame: int | None = None,
    resume: bool = False,
    force: bool = False,
    force_memory: bool = False,
    stop: Callable[[], bool | str] = lambda: False,
    profile: Profile | None = None,
) -> RunRecord:
    """Simulate a scene into a folder that all ranks see; collective.

    Args:
        scene: what to simulate, the same on all ranks.
        out: the run's folder.
        meeting: of the ranks.
        device: of this rank.
        observer: learns of every step; one that says nothing, but on the first rank.
        overrides: as of `run_scene`.
        last_frame: as of `run_scene`.
        resume: as of `run_scene`; the run may have had another number of ranks.
        force: as of `run_scene`.
        force_memory: run even what will not fit into the free memory of the ranks' devices.
        stop: asked after every step; True on any rank ends the run with a checkpoint.
        profile: measures the stages; on the first rank alone.

    Returns:
        How the run ended.

    Raises:
        OutputError: the folder cannot take the run; on all ranks, as everything here.
        SceneError: the scene cannot be simulated, or not on ranks.
    """
    share = _share(meeting, device)
    with meeting.together():
        simulator = _simulator(scene)
        if not force_memory:
            check_memory(scene, device, share=share)
    folder = ParallelRunFolder(out, scene, meeting)

    def create(continued: Continuation | None) -> tuple[Simulation, list[str]]:
        with meeting.together():
            simulation = _create(simulator, scene, meeting, device, folder, continued)
        return AgreedSimulation(simulation, meeting), simulation.notes()

    ranks = meeting.ranks
    record = RunRecord(
        scene.scene.name, scene.scene.simulator, device, engine=Engine.PETSC.value, ranks=ranks.size, overrides=list(overrides)
    )  # fmt: skip
    return run_in_folder(
        folder, record, create, observer=observer, last_frame=last_frame, resume=resume, force=force, stop=stop, profile=profile,
        somewhere=ranks.any,
    )  # fmt: skip


def _simulator(scene: Scene) -> DistributedSimulator:
    """Return what simulates a scene on ranks.

    Raises:
        SceneError: nothing does, or its output cannot be written in pieces.
    """
    name = scene.scene.simulator
    simulator = simulators()[name]
    problems = []
    if not isinstance(simulator, DistributedSimulator):
        problems.append(Problem("scene.simulator", "runs on one process only; leave out --engine petsc", written(name)))
    if scene.output.volume:
        problems.append(Problem("output.volume", "--engine petsc has no volumes, which cannot be written in pieces", "true"))
    if scene.output.surface_ply:
        problems.append(Problem("output.surface_ply", "--engine petsc writes surfaces as .vtu pieces alone", "true"))
    if problems:
        raise SceneError(scene.scene.name, problems)
    assert isinstance(simulator, DistributedSimulator)
    return simulator


def _create(
    simulator: DistributedSimulator,
    scene: Scene,
    meeting: Meeting,
    device: str,
    folder: ParallelRunFolder,
    continued: Continuation | None,
) -> DistributedSimulation:
    """Return this rank's part of the simulation where the run begins or goes on."""
    try:
        simulation = simulator.create_distributed(scene, meeting.ranks, device=device, folder=Path.cwd())
        if continued and continued.checkpoint:
            if continued.resampled_from is not None:
                raise ValueError(f"domain.resolution: must stay {continued.resampled_from}: --engine petsc cannot change grids")
            if PIECES in continued.checkpoint.state:
                simulation.restore_pieces(folder.checkpoints.pieces(continued.checkpoint))
            else:
                simulation.restore(continued.checkpoint.state)
    except ValueError as error:
        raise SceneError(scene.scene.name, [Problem("", str(error))]) from error
    return simulation


def _share(meeting: Meeting, device: str) -> float:
    """Return what part of a run is on the device of this rank, which others of its machine may have too."""
    places = meeting.exchange((socket.gethostname(), device))
    return places.count(places[meeting.ranks.rank]) / len(places)
