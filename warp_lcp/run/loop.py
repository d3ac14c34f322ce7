"""Time loop: step retries, exact frame times, checkpoints, exit status."""

from __future__ import annotations

import errno
import time as clock
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from warp_lcp.distributed.collective import Collective, RankFailed
from warp_lcp.frames.frame_folder import FrameWriter, frame_bytes
from warp_lcp.run.check import check_memory, check_output, check_ranks, start
from warp_lcp.run.checkpoint import PIECES, Checkpoint
from warp_lcp.run.devices import Engine
from warp_lcp.run.folder import BEFORE, Continuation, OutputError, RunFolder, RunRecord, read_record
from warp_lcp.run.interruption import RunInterrupted
from warp_lcp.run.log import Log, Value
from warp_lcp.run.problem_folder import ProblemFolder
from warp_lcp.run.profile import Profiler
from warp_lcp.run.progress import Observer, missed, residual_of
from warp_lcp.run.rank_simulation import RankSimulation
from warp_lcp.run.stepping import stable_dt, take_step
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.table import KeyFault, SceneError
from warp_lcp.simulation import (
    Cells,
    HasPieces,
    HasRecordedProblems,
    HasResampling,
    HasStages,
    HasTables,
    NoStopwatch,
    Part,
    Points,
    Simulation,
    SimulationFailed,
    StepFailed,
    Stopwatch,
)

# Relative to the interval of frames: rounding of the time at the end of a frame.
SAME_TIME = 1e-9
SPACE_MARGIN = 1.1


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """Options of a run, as of `warp-lcp run`.

    Args:
        scene: the scene, the same on all ranks.
        out: the run's folder, visible to all ranks; no files are written if None.
        device: Warp device of this rank, such as `cuda:0`.
        overrides: differences of the scene from its file, for run.json, see
            `warp_lcp.run.resolve_scene`.
        last_frame: frame after which the run ends; default: the scene's last one.
        resume: continue the run in the folder, from any number of ranks.
        force: delete the run in the folder.
        force_memory: run even if the estimated memory exceeds the device's free memory.
        record_problems: folder for the problem of each step, see `warp_lcp.recorded_problem`; not
            on ranks.
    """

    scene: Scene
    out: Path | None
    device: str = "cpu"
    overrides: Sequence[dict[str, str]] = ()
    last_frame: int | None = None
    resume: bool = False
    force: bool = False
    force_memory: bool = False
    record_problems: Path | None = None


def run_scene(
    request: RunRequest,
    *,
    observer: Observer,
    stop: Callable[[], bool | str] = lambda: False,
    profile: Profiler | None = None,
    collective: Collective | None = None,
) -> RunRecord:
    """Simulate a scene into a folder; collective if ranks share the run.

    Arguments, return value and errors are those of `running_scene`.
    """
    running = running_scene(
        request, observer=observer, stop=stop, profile=profile, collective=collective
    )
    while True:
        try:
            next(running)
        except StopIteration as end:
            return cast(RunRecord, end.value)


def running_scene(
    request: RunRequest,
    *,
    observer: Observer,
    stop: Callable[[], bool | str] = lambda: False,
    profile: Profiler | None = None,
    collective: Collective | None = None,
) -> Generator[RunLoop, None, RunRecord]:
    """Simulate a scene as far as frames are requested; collective on ranks.

    Between frames the caller may change the simulation. When the generator is closed, the run ends
    as a stopped run.

    Args:
        request: options of the run.
        observer: observer of every step.
        stop: called after every step; True, or the name of a signal, on any rank ends the run with
            a checkpoint.
        profile: measures the run's stages; written to profile.json at the end.
        collective: collective operations of the ranks that share the run; None for one process.

    Yields:
        The loop before the first step, and again at each frame of this run, with the simulation in
        the state of the frame.

    Returns:
        The record of the run, as in run.json.

    Raises:
        OutputError: the folder cannot be used for the run; on all ranks, like all errors here.
        SceneError: the scene cannot be simulated, or not on ranks.
    """
    scene, group = request.scene, collective or Collective.for_one_process()
    if collective is not None and request.record_problems is not None:
        raise OutputError(
            "--record-problems cannot be combined with --engine petsc: each rank has only a part "
            "of the problem"
        )
    share = group.share_of_device(request.device)
    with group.together():
        if collective is not None:
            check_ranks(scene)
        output_notes = check_output(scene) if request.out is not None else []
        if not request.force_memory:
            check_memory(scene, request.device, share=share)
    folder = None if request.out is None else RunFolder(request.out, scene, collective)
    if folder is None and request.resume:
        raise OutputError("resume: a run without a folder has no checkpoints")
    record = RunRecord(
        scene.scene.name, scene.scene.simulator, request.device, overrides=list(request.overrides)
    )
    if collective is not None:
        record.engine, record.ranks = Engine.PETSC.value, collective.ranks.size
    with folder.held(resume=request.resume) if folder else nullcontext(list[str]()) as remarks:
        record.warnings = [*remarks, *output_notes]
        continued = _open(folder, request, record) if folder else None
        with group.together():
            simulation, notes = _simulation(request, folder, collective, continued)
        record.warnings += notes
        for note in record.warnings:
            observer.note(note)
        for change in record.changed:
            observer.note(f"changed: {change}")
        checkpoint = continued.checkpoint if continued else None
        run = RunLoop(simulation, scene, folder, record, observer, profile, group)
        with profile.kernels_apart() if profile else nullcontext():
            yield run
            return (
                yield from run.execute(request.last_frame, stop, resumed=checkpoint is not None)
            )


def _open(folder: RunFolder, request: RunRequest, record: RunRecord) -> Continuation | None:
    """Check that a run can use its folder; return what a resumed run continues from."""
    record.mesh_files = folder.mesh_files
    if not request.resume:
        folder.check_new(force=request.force)
        return None
    continued = folder.resume()
    record.overrides = record.overrides or read_record(folder.path).get("overrides", [])
    record.warnings += continued.remarks
    record.changed, record.resampled_from_resolution = continued.changed, continued.resampled_from
    record.resumed_from_step = continued.checkpoint.step if continued.checkpoint else 0
    return continued


def _simulation(
    request: RunRequest,
    folder: RunFolder | None,
    collective: Collective | None,
    continued: Continuation | None,
) -> tuple[Simulation, list[str]]:
    """Return the simulation at the start of the run, and its remarks.

    On ranks, this rank's part; a resumed run starts from its checkpoint.
    """
    scene, notes = request.scene, list[str]()
    simulation = start(scene, request.device, collective.ranks if collective else None)
    try:
        if folder and continued and continued.checkpoint:
            notes = _continue_from_checkpoint(
                simulation, folder, continued, on_ranks=collective is not None
            )
    except ValueError as error:
        raise SceneError(scene.scene.name, [KeyFault("", str(error))]) from error
    if request.record_problems is not None:
        _record_problems(simulation, scene, request.record_problems, more=request.resume)
    notes = simulation.notes() + notes
    if collective is None:
        return simulation, notes
    return RankSimulation(cast(HasPieces, simulation), collective), notes


def _continue_from_checkpoint(
    simulation: Simulation, folder: RunFolder, continued: Continuation, *, on_ranks: bool
) -> list[str]:
    """Continue from a checkpoint; return remarks for the user.

    Raises:
        ValueError: the simulation cannot continue from it.
    """
    assert continued.checkpoint is not None
    state, name, other_grid = (
        continued.checkpoint.state,
        folder.scene.scene.simulator,
        continued.resampled_from is not None,
    )
    if PIECES in state and not isinstance(simulation, HasPieces):
        raise ValueError(
            "the checkpoint was written on several ranks: continue with --engine petsc, on any "
            "number of ranks"
        )
    if other_grid and (on_ranks or PIECES in state or not isinstance(simulation, HasResampling)):
        who = "--engine petsc" if on_ranks else name
        why = (
            "the checkpoint was written on several ranks"
            if PIECES in state and not on_ranks
            else f"{who} cannot change grids"
        )
        raise ValueError(f"domain.resolution: must stay {continued.resampled_from}: {why}")
    if PIECES in state and isinstance(simulation, HasPieces):
        simulation.restore_pieces(folder.checkpoints.pieces(continued.checkpoint))
    elif other_grid and isinstance(simulation, HasResampling):
        return simulation.resample(state)
    else:
        simulation.restore(state)
    return []


def _record_problems(simulation: Simulation, scene: Scene, folder: Path, *, more: bool) -> None:
    """Let a simulation write the problem of each step into a folder."""
    if not isinstance(simulation, HasRecordedProblems):
        raise OutputError(
            f"--record-problems: the simulator {scene.scene.simulator} has no problems to record"
        )
    if any(solid.is_body for solid in scene.solid):
        raise OutputError(
            "--record-problems cannot be combined with rigid bodies, whose part of the matrix "
            "cannot be stored"
        )
    simulation.record = ProblemFolder(folder, more=more).write


class RunLoop:
    """Time loop of a simulation over its frames.

    Args:
        simulation: the simulation at the start of the run.
        scene: the scene of the run.
        folder: folder for the output; None: no files are written.
        record: record of the run.
        observer: observer of every step.
        profile: timer of the stages.
        collective: collective operations of the ranks that share the run.
    """

    def __init__(
        self,
        simulation: Simulation,
        scene: Scene,
        folder: RunFolder | None,
        record: RunRecord,
        observer: Observer,
        profile: Profiler | None,
        collective: Collective,
    ) -> None:
        """Store the simulation and the settings; nothing is written yet."""
        self.time = scene.time
        self.output = scene.output
        self.simulation = simulation
        self.folder = folder
        self.record = record
        self.observer = observer
        self.profile = profile
        self.collective = collective
        self.watch: Stopwatch = profile or NoStopwatch()
        if isinstance(simulation, HasStages):
            simulation.watch = self.watch
        self.writer = folder.frame_writer(self.watch) if folder else None
        # Facts that one process knows hold for the run if they do on any rank.
        self._somewhere = collective.ranks.any
        # Surfaces of bodies are part of every frame.
        self._has_bodies = any(solid.is_body for solid in scene.solid)
        self._start_time = clock.perf_counter()
        self._first_step = 0
        self._below_dt_min = False
        # Whether the frame at the time of the checkpoint is missing.
        self._owes = False
        # Residuals of solves that missed their tolerance, and their steps.
        self._missed: list[tuple[float, int]] = []
        self._tolerance = scene.solver.tolerance
        # Open files with a row per step, by name: the log and other tables; none without a folder.
        self._logs: dict[str, Log] = {}
        self._checkpointed: int | None = None  # step of the newest checkpoint
        self._checkpoint_time = clock.monotonic()

    def execute(
        self, last_frame: int | None, stop: Callable[[], bool | str], *, resumed: bool
    ) -> Generator[RunLoop, None, RunRecord]:
        """Run to the last frame and write the exit status into run.json."""
        count = self.time.frame_count
        last = count if last_frame is None else min(last_frame, count)
        start = self._frame()
        self._check_space(last, start)
        try:
            # Errors caught here were raised on all ranks.
            with self.collective.together(), ExitStack() as stack:
                if self.writer:
                    stack.enter_context(self.writer)
                stack.callback(self._logs.clear)
                if resumed:
                    self._resume(stack, last, start)
                else:
                    self._start(stack, last, start)
                for name, columns in self._table_columns().items():
                    self._open_log(stack, name, columns, self._first_step if resumed else None)
                self.observer.start(self.simulation.time, self.time.frame_time(last))
                try:
                    stopped = yield from self._advance(last, stop, resumed=resumed)
                except GeneratorExit:
                    # No more frames are requested; the state is that of the last one.
                    stopped = f"stopped by the program after frame {self._frames_done()}"
                self._write_checkpoint()
            self.record.status = "stopped" if stopped else "finished"
            self.record.reason = stopped or f"frame {last} of {count} reached"
        except RunInterrupted as error:  # the checkpoint before the first step exists
            self.record.status, self.record.reason = "stopped", f"interrupted by {error} {BEFORE}"
        except (StepFailed, SimulationFailed) as error:
            self._fail(str(error))
            if self.writer:
                self._try_to(self.writer.flush)
            if isinstance(error, StepFailed):  # the state is that before the step
                self._try_to(self._write_checkpoint)
        except OSError as error:
            full = "the disk is full: " if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
            self._fail(f"{full}{error}; files written before are intact")
        except Exception as error:  # raised again below
            self._fail(
                str(error) if isinstance(error, RankFailed) else f"{type(error).__name__}: {error}"
            )
            raise
        finally:
            if self.record.status == "running":
                self._fail("the program ended unexpectedly")
            self._report_missed_tolerance()
            self._try_to(self._write_record)
            if self.profile and self.folder:
                self._try_to(partial(self._write_profile, self.profile, self.folder))
        return self.record

    def _check_space(self, last: int, frame: list[Part]) -> None:
        """Raise an error if the output of the remaining frames does not fit."""
        if self.folder is None:
            return
        frames = max(0, last - self._frames_done() + 1)
        state = sum(array.nbytes for array in self.simulation.state().values())
        states = self.output.checkpoints_kept + 1  # with the one that is being written
        output = self.output
        each = frame_bytes(
            frame, output.grid_format, surface_ply=output.surface_ply, frame_format=output.format
        )
        self.folder.check_space(int(SPACE_MARGIN * (each * frames + states * state)))

    def _start(self, stack: ExitStack, last: int, frame: list[Part]) -> None:
        """Write the output before the first step; a stack closes the log."""
        if self.folder:
            self.folder.start(self.record)
        self._open_log(stack, "log", self._columns())
        self._write_frame(0, last, frame)
        self._write_checkpoint()  # so that a run can always be continued

    def _resume(self, stack: ExitStack, last: int, frame: list[Part]) -> None:
        """Remove output after the checkpoint, and report missing output before it.

        A run that failed between a step and the frame at its end, for instance in a callback, lacks
        that frame: the checkpoint has its time, so it is written now. A stack closes the log.
        """
        folder = cast(RunFolder, self.folder)  # from which the run is resumed
        self.record.frames = done = self._frames_done()
        self._first_step = self.simulation.step_count
        self._count()
        times = [self.time.frame_time(index) for index in range(done + 1)]
        self._owes = (
            self._is_frame_time(done) and done <= last and folder.is_missing_files(done, frame)
        )
        if self._owes:
            times.pop()
        for gap in folder.gaps(
            {"log": self._columns(), **self._table_columns()}, self._first_step, times, frame
        ):
            self._warn(gap)
        folder.prepare_continuation(self.record, self._first_step)
        folder.frames.resume(times)
        self._open_log(stack, "log", self._columns(), self._first_step)
        if self._owes:
            self._write_frame(done, last, frame)

    def _open_log(
        self, stack: ExitStack, name: str, columns: tuple[str, ...], after_step: int | None = None
    ) -> None:
        """Open the log or another table, which a stack closes."""
        if self.folder:
            log = self.folder.open_log(columns, after_step=after_step, table=name)
            self._logs[name] = stack.enter_context(closing(log))

    def _table_columns(self) -> Mapping[str, tuple[str, ...]]:
        return self.simulation.tables() if isinstance(self.simulation, HasTables) else {}

    def _columns(self) -> tuple[str, ...]:
        return ("step", "time", "dt", *self.simulation.columns(), "retries", "seconds")

    def _advance(
        self, last: int, stop: Callable[[], bool | str], *, resumed: bool
    ) -> Generator[RunLoop, None, str]:
        """Step until the last frame is written; return the reason of an early stop.

        "" if the run did not stop early.
        """
        frame = self._frames_done() + 1
        if not resumed or self._owes:
            yield self
        while frame <= last:
            row = self._step(self.time.frame_time(frame))
            done = self._frames_done() >= frame
            with self._keeping_step():
                for name, log in self._logs.items():
                    log.append(
                        row if name == "log" else cast(HasTables, self.simulation).measured[name]
                    )
                self.observer.step(row)
                if missed(row):
                    self._missed.append((residual_of(row) or 0.0, self.simulation.step_count))
                if self.writer:
                    self.writer.check()
                if done:
                    self._write_frame(frame, last, self._frame())
            if done:
                yield self
                frame += 1
            if self._checkpoint_is_due():
                self._write_checkpoint(beside=True)
            asked = stop()
            if self._somewhere(bool(asked)) and frame <= last:
                return self._interrupted(asked)
        return ""

    @contextmanager
    def _keeping_step(self) -> Iterator[None]:
        """Context after a step: on an error on any rank, write a checkpoint.

        It is written if the disk allows.
        """
        try:
            with self.collective.together():
                yield
        except (Exception, KeyboardInterrupt) as error:  # raised again below
            self._try_to(self._write_checkpoint)
            if isinstance(error, KeyboardInterrupt):
                self.record.status, self.record.reason = (
                    "stopped",
                    f"interrupted after step {self.simulation.step_count}",
                )
            raise

    def _interrupted(self, requested: bool | str) -> str:
        """Return the stop request of any rank."""
        names = [
            name if isinstance(name, str) else "" for name in self.collective.exchange(requested)
        ]
        rank = next((rank for rank, name in enumerate(names) if name), 0)
        return (
            f"interrupted by {names[rank]}{f' on rank {rank}' if rank else ''}"
            if names[rank]
            else "interrupted"
        )

    def _step(self, end: float) -> dict[str, Value]:
        """Run a step toward a time [s] and return its log row."""
        start_time = clock.perf_counter()
        stable, number = stable_dt(self.simulation), self.simulation.step_count + 1
        if stable < self.time.dt_min and not self._below_dt_min:
            self._below_dt_min = True  # one warning is enough: the log column cfl has the rest
            self._warn(
                f"step {number}: the longest stable step is {stable:.3g} s, less than time.dt_min; "
                "steps may be unstable"
            )
        dt, retries, values = take_step(self.simulation, stable, end, self.time)
        seconds = clock.perf_counter() - start_time
        return {
            "step": self.simulation.step_count,
            "time": self.simulation.time,
            "dt": dt,
            **values,
            "retries": retries,
            "seconds": seconds,
        }

    def _is_frame_time(self, index: int) -> bool:
        """Return whether the simulation is at the time of a frame."""
        return (
            abs(self.simulation.time - self.time.frame_time(index))
            <= SAME_TIME / self.time.frames_per_second
        )

    def _frames_done(self) -> int:
        """Return the number of the newest frame whose time is reached.

        It depends on the time only.
        """
        interval = 1.0 / self.time.frames_per_second
        reached = self.simulation.time + SAME_TIME * interval
        frame = min(int(reached / interval), self.time.frame_count)
        if frame > 0 and self.time.frame_time(frame) > reached:
            frame -= 1
        elif frame < self.time.frame_count and self.time.frame_time(frame + 1) <= reached:
            frame += 1
        return frame

    def _frame(self) -> list[Part]:
        """Return the parts of a frame that the scene requests."""
        output = self.output
        if self.folder is None or not (
            output.particles or output.grid or output.surface or output.volume or self._has_bodies
        ):
            return []
        wanted = {Points: output.particles, Cells: output.grid}
        with self.watch.stage("frames"):
            return [part for part in self.simulation.frame() if wanted.get(type(part), True)]

    def _write_frame(self, index: int, last: int, frame: list[Part]) -> None:
        if self.writer:
            with self.watch.stage("frames"):
                self.writer.put(index, self.time.frame_time(index), frame)
        else:
            self.record.frames = index
        self.observer.frame(index, last)

    def _checkpoint_is_due(self) -> bool:
        every, minutes = self.output.checkpoint_every, self.output.checkpoint_minutes
        if every and self.simulation.step_count % every == 0:
            return True
        return minutes is not None and self._somewhere(
            clock.monotonic() - self._checkpoint_time >= 60.0 * minutes
        )

    def _write_checkpoint(self, *, beside: bool = False) -> None:
        """Write a checkpoint unless there is one of this step.

        All output that a resumed run expects is written to disk before.

        Args:
            beside: write while the run continues.
        """
        step = self.simulation.step_count
        if self._checkpointed == step or self.folder is None or self.writer is None:
            return
        store = partial(self._store, self.folder)
        files: list[Path] = []
        with self.watch.stage("checkpoints"):
            for log in self._logs.values():
                log.sync()
            if beside and isinstance(self.writer, FrameWriter):  # ranks write together
                state = {name: np.array(array) for name, array in self.simulation.state().items()}
                self.writer.queue_files(
                    "checkpoints, written",
                    partial(store, Checkpoint(step, self.simulation.time, state)),
                )
            else:
                self.writer.flush()
                files = store(Checkpoint(step, self.simulation.time, self.simulation.state()))
        self.watch.add_file_sizes("checkpoints", *files)
        self._checkpointed, self._checkpoint_time = step, clock.monotonic()

    def _store(self, folder: RunFolder, checkpoint: Checkpoint) -> list[Path]:
        file = folder.checkpoints.write(checkpoint)
        folder.checkpoints.prune(self.output.checkpoints_kept)
        return [file]

    def _write_profile(self, profile: Profiler, folder: RunFolder) -> None:
        profile.write(
            folder.path, self.simulation.step_count - self._first_step, self.record.seconds
        )

    def _count(self) -> None:
        """Update the record."""
        if self.writer and self.writer.newest is not None:
            self.record.frames = self.writer.newest
        self.record.steps, self.record.time = self.simulation.step_count, self.simulation.time
        self.record.seconds = round(clock.perf_counter() - self._start_time, 3)

    def _write_record(self) -> None:
        self._count()
        if self.folder:
            self.folder.write_record(self.record)

    def _report_missed_tolerance(self) -> None:
        """Warn about steps of this run whose solve missed its tolerance."""
        if self._missed:
            (worst, step), steps = max(self._missed), self.simulation.step_count - self._first_step
            left = f": the worst, step {step}, left a residual of {worst:.1e}" * (worst > 0.0)
            self._warn(
                f"{len(self._missed)} of {steps} steps missed solver.tolerance = "
                f"{self._tolerance}{left}"
            )

    def _fail(self, reason: str) -> None:
        self.record.status = "failed"
        self.record.reason = reason

    def _try_to(self, write: Callable[[], None]) -> None:
        """Write a file after a failure; a further failure becomes a warning."""
        try:
            write()
        except OSError as error:
            self._warn(f"could not be written: {error}")

    def _warn(self, text: str) -> None:
        self.record.warnings.append(text)
        self.observer.note(f"warning: {text}")
