"""The run loop: frames at their exact times, steps that are tried again, checkpoints, and an honest end."""

from __future__ import annotations

import errno
import math
import time as clock
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, nullcontext
from pathlib import Path

from warp_lcp.frames.frames import frame_bytes
from warp_lcp.run.check import check_memory, start
from warp_lcp.run.checkpoint import PIECES, Checkpoint
from warp_lcp.run.folder import BEFORE, Continuation, OutputError, RunFolder, RunRecord, read_record
from warp_lcp.run.interruption import Interrupted
from warp_lcp.run.log import Log, Value
from warp_lcp.run.problem_folder import ProblemFolder
from warp_lcp.run.profile import Profile
from warp_lcp.run.progress import Observer, missed, residual_of
from warp_lcp.scene.scene import Scene, Time
from warp_lcp.scene.table import Problem, SceneError
from warp_lcp.simulation import (
    Cells,
    Joined,
    NoStopwatch,
    Part,
    Points,
    Profiled,
    Recorded,
    Resampled,
    Scheduled,
    Simulation,
    SimulationFailed,
    StepFailed,
    Stopwatch,
    Surface,
    Volume,
)

RETRIES = 6  # halvings of dt: a step 64 times shorter that still fails has another cause than its length
SHARE = 0.25  # of a step: what starts or stops closer to a step's end than that makes no step of its own
SAME_TIME = 1e-9  # of a frame's interval: what rounding leaves between a step's end and the frame it was cut for
SPACE_MARGIN = 1.1


def run_scene(
    scene: Scene,
    out: Path,
    *,
    device: str,
    observer: Observer,
    overrides: Sequence[dict[str, str]] = (),
    last_frame: int | None = None,
    resume: bool = False,
    force: bool = False,
    force_memory: bool = False,
    stop: Callable[[], bool | str] = lambda: False,
    profile: Profile | None = None,
    record_problems: Path | None = None,
) -> RunRecord:
    """Simulate a scene into a folder.

    Args:
        scene: what to simulate.
        out: the run's folder.
        device: a Warp device, such as `cuda:0`.
        observer: learns of every step.
        overrides: by which the scene differs from its file, for run.json, see `warp_lcp.run.given_scene`.
        last_frame: end after this frame; the scene's last one without it.
        resume: continue the run in the folder.
        force: delete the run in the folder.
        force_memory: run even what will not fit into the device's free memory.
        stop: asked after every step; True, or what it is interrupted by, ends the run with a checkpoint.
        profile: measures the run's stages; written to profile.json at the end.
        record_problems: folder that takes the problem of each step, see `warp_lcp.gallery.recorded`.

    Returns:
        How the run ended, as in run.json.

    Raises:
        OutputError: the folder cannot take the run.
        SceneError: the scene cannot be simulated.
    """
    if not force_memory:
        check_memory(scene, device)

    folder = RunFolder(out, scene)

    def create(continued: Continuation | None) -> tuple[Simulation, list[str]]:
        simulation, notes = _create(folder, device, continued)
        if record_problems is not None:
            _record_problems(simulation, scene, record_problems, more=resume)
        return simulation, notes

    record = RunRecord(scene.scene.name, scene.scene.simulator, device, overrides=list(overrides))
    return run_in_folder(
        folder,
        record,
        create,
        observer=observer,
        last_frame=last_frame,
        resume=resume,
        force=force,
        stop=stop,
        profile=profile,
    )


def run_in_folder(
    folder: RunFolder,
    record: RunRecord,
    create: Callable[[Continuation | None], tuple[Simulation, list[str]]],
    *,
    observer: Observer,
    last_frame: int | None,
    resume: bool,
    force: bool,
    stop: Callable[[], bool | str],
    profile: Profile | None,
    somewhere: Callable[[bool], bool] = bool,
) -> RunRecord:
    """Simulate into a folder.

    Args:
        folder: of the run.
        record: with what is known of it.
        create: returns the simulation where the run begins, or where it goes on, and what there is to say of it.
        observer: learns of every step.
        last_frame: end after this frame.
        resume: continue the run in the folder.
        force: delete the run in the folder.
        stop: asked after every step.
        profile: measures the run's stages.
        somewhere: see `Run`.

    Returns:
        How the run ended.

    Raises:
        OutputError: the folder cannot take the run.
        SceneError: the scene cannot be simulated.
    """
    with folder.held(resume=resume) as remarks:
        record.warnings, record.mesh_files = list(remarks), folder.mesh_files
        continued: Continuation | None = None
        if resume:
            continued = folder.resume()
            record.overrides = record.overrides or read_record(folder.path).get("overrides", [])
            record.warnings += continued.remarks
            record.changed, record.resampled_from_resolution = continued.changed, continued.resampled_from
            record.resumed_from_step = continued.checkpoint.step if continued.checkpoint else 0
        else:
            folder.check_new(force=force)
        simulation, notes = create(continued)
        record.warnings += notes
        for note in record.warnings:
            observer.note(note)
        for change in record.changed:
            observer.note(f"changed: {change}")
        checkpoint = continued.checkpoint if continued else None
        run = Run(folder.scene, simulation, folder, record, observer, profile, somewhere)
        with profile.kernels_apart() if profile else nullcontext():
            return run.execute(last_frame, stop, resumed=checkpoint is not None)


def _create(folder: RunFolder, device: str, continued: Continuation | None) -> tuple[Simulation, list[str]]:
    """Return the simulation where the run begins or goes on, and what it has to say."""
    scene = folder.scene
    simulation = start(scene, device)
    try:
        notes: list[str] = []
        if continued and continued.checkpoint:
            state = continued.checkpoint.state
            if PIECES in state:
                _join(simulation, folder, continued)
            elif continued.resampled_from is None:
                simulation.restore(state)
            elif isinstance(simulation, Resampled):
                notes = simulation.resample(state)
            else:
                raise ValueError(f"domain.resolution: must stay {continued.resampled_from}: {scene.scene.simulator} cannot change grids")
    except ValueError as error:
        raise SceneError(scene.scene.name, [Problem("", str(error))]) from error
    return simulation, simulation.notes() + notes


def _join(simulation: Simulation, folder: RunFolder, continued: Continuation) -> None:
    """Continue from the pieces of ranks."""
    assert continued.checkpoint is not None
    if not isinstance(simulation, Joined):
        raise ValueError("the checkpoint is one of several ranks: continue with --engine petsc, on any number of ranks")
    if continued.resampled_from is not None:
        raise ValueError(f"domain.resolution: must stay {continued.resampled_from}: the checkpoint is one of several ranks")
    simulation.restore_pieces(folder.checkpoints.pieces(continued.checkpoint))


def _record_problems(simulation: Simulation, scene: Scene, folder: Path, *, more: bool) -> None:
    """Have a simulation write the problem of each step into a folder."""
    if not isinstance(simulation, Recorded):
        raise OutputError(f"--record-problems: the simulator {scene.scene.simulator} has no problems to show")
    if any(solid.is_body for solid in scene.solid):
        raise OutputError("--record-problems: the files have no place for the part of the matrix that rigid bodies add; take them out")
    simulation.record = ProblemFolder(folder, more=more).write


def plan_dt(stable: float, remaining: float, time: Time, events: Sequence[float] = ()) -> float:
    """Return the next step [s]: within the scene's bounds, ending on the frame's time, never leaving a sliver before it.

    It depends on nothing but the state, so a run that was interrupted takes the same steps. The last two steps before a frame or an event
    are equal; they may be shorter than dt_min. Steps run across events that are closer than SHARE dt to now or to the frame, and of several
    within dt across all but the last.

    Args:
        stable: what the CFL number allows [s].
        remaining: the time to the next frame [s].
        time: the scene's bounds.
        events: the times from now [s] to those at which steps should end.
    """
    dt = min(max(stable, time.dt_min), time.dt_max)
    later = [event for event in events if SHARE * dt <= event <= remaining - SHARE * dt]
    ahead = max((event for event in later if event <= dt), default=min(later, default=remaining))
    if ahead <= dt:
        return ahead
    return ahead / 2 if ahead < 2 * dt else dt


def take_step(simulation: Simulation, stable: float, end: float, time: Time) -> tuple[float, int, dict[str, Value]]:
    """Take a step, or a shorter one where it fails; return its length [s], how often it was halved and what the log gets.

    Args:
        simulation: that takes it.
        stable: what the CFL number allows [s].
        end: the next frame's time [s].
        time: the scene's bounds.

    Raises:
        StepFailed: the shortest step failed too.
        SimulationFailed: the run cannot go on.
    """
    now, retries = simulation.time, 0
    events = simulation.events(end) if isinstance(simulation, Scheduled) else []
    dt = plan_dt(stable, end - now, time, [event - now for event in events])
    while True:
        try:
            return dt, retries, simulation.step(dt)
        except StepFailed as error:
            if retries == RETRIES or dt / 2 < time.dt_min:
                number = simulation.step_count + 1
                raise StepFailed(f"step {number} at t = {now:.6g} s, dt = {dt:.3g} s, retries {retries}: {error}") from error
            retries, dt = retries + 1, dt / 2


class Run:
    """A simulation on its way through its frames.

    Args:
        scene: what is simulated.
        simulation: where it begins or goes on.
        folder: takes the output.
        record: says how the run ends.
        observer: learns of every step.
        profile: measures the stages.
        somewhere: tells whether something that only this process knows holds for the run; where several run it, on some of them.
    """

    def __init__(
        self,
        scene: Scene,
        simulation: Simulation,
        folder: RunFolder,
        record: RunRecord,
        observer: Observer,
        profile: Profile | None,
        somewhere: Callable[[bool], bool] = bool,
    ) -> None:
        """Take over a simulation; nothing is written yet."""
        self.time = scene.time
        self.output = scene.output
        self.simulation = simulation
        self.folder = folder
        self.record = record
        self.observer = observer
        self.profile = profile
        self.watch: Stopwatch = profile or NoStopwatch()
        if isinstance(simulation, Profiled):
            simulation.watch = self.watch
        self.writer = folder.frame_writer(self.watch)
        self._somewhere = somewhere
        self._has_bodies = any(solid.is_body for solid in scene.solid)  # whose surfaces are part of every frame
        self._begun = clock.perf_counter()
        self._first_step = 0
        self._below_dt_min = False
        self._missed: list[tuple[float, int]] = []  # what solves left that missed their tolerance, and in which step
        self._tolerance = scene.solver.tolerance
        self._checkpointed: int | None = None  # the newest checkpoint's step
        self._checkpoint_time = clock.monotonic()

    def execute(self, last_frame: int | None, stop: Callable[[], bool | str], *, resumed: bool) -> RunRecord:
        """Run to the last frame, and write in run.json how that ended, whatever happened."""
        count = self.time.frame_count
        last = count if last_frame is None else min(last_frame, count)
        start = self._frame()
        self._check_space(last, start)
        try:
            with self.writer, closing(self._resume(start) if resumed else self._start(last, start)) as log:
                self.observer.start(self.simulation.time, self.time.frame_time(last))
                stopped = self._advance(log, last, stop)
                self._write_checkpoint(log)
            self.record.status = "stopped" if stopped else "finished"
            self.record.reason = stopped or f"frame {last} of {count} reached"
        except Interrupted as error:  # the checkpoint before the first step is there
            self.record.status, self.record.reason = "stopped", f"interrupted by {error} {BEFORE}"
        except (StepFailed, SimulationFailed) as error:
            self._fail(str(error))
            self._try_to(self.writer.flush)
            if isinstance(error, StepFailed):  # the state is as before the step
                self._try_to(self._write_checkpoint)
        except OSError as error:
            full = "the disk is full: " if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
            self._fail(f"{full}{error}; what was written before is intact")
        finally:
            if self.record.status == "running":
                self._fail("the program ended unexpectedly")
            self._tell_missed()
            self._try_to(self._write_record)
            if self.profile:
                self._try_to(self._write_profile)
        return self.record

    def _check_space(self, last: int, frame: list[Part]) -> None:
        frames = max(0, last - self._frames_done() + 1)
        state = sum(array.nbytes for array in self.simulation.state().values())
        states = self.output.checkpoints_kept + 1  # the one being written too
        each = frame_bytes(frame, self.output.grid_format, surface_ply=self.output.surface_ply)
        self.folder.check_space(int(SPACE_MARGIN * (each * frames + states * state)))

    def _start(self, last: int, frame: list[Part]) -> Log:
        """Write what there is before the first step."""
        self.folder.start(self.record)
        with ExitStack() as stack:
            log = stack.enter_context(closing(self.folder.open_log(self._columns())))
            self._write_frame(0, last, frame)
            self._write_checkpoint(log)  # so that a run can be continued from its first moment on
            stack.pop_all()
        return log

    def _resume(self, frame: list[Part]) -> Log:
        """Take back what an interrupted run wrote after its checkpoint, and tell what is missing of what it wrote before."""
        self.record.frames = self._frames_done()
        self._first_step = self.simulation.step_count
        self._count()
        times = [self.time.frame_time(index) for index in range(self.record.frames + 1)]
        for gap in self.folder.gaps(self._columns(), self._first_step, times, frame):
            self._warn(gap)
        self.folder.go_on(self.record, self._first_step)
        self.folder.frames.resume(times)
        return self.folder.open_log(self._columns(), after_step=self._first_step)

    def _columns(self) -> tuple[str, ...]:
        return ("step", "time", "dt", *self.simulation.columns(), "retries", "seconds")

    def _advance(self, log: Log, last: int, stop: Callable[[], bool | str]) -> str:
        """Step until the last frame is written; return why the run stopped before, "" if it did not."""
        frame = self._frames_done() + 1
        while frame <= last:
            row = self._step(self.time.frame_time(frame))
            log.append(row)
            self.observer.step(row)
            if missed(row):
                self._missed.append((residual_of(row) or 0.0, self.simulation.step_count))
            self.writer.check()
            if self._frames_done() >= frame:
                self._write_frame(frame, last, self._frame())
                frame += 1
            if self._checkpoint_is_due():
                self._write_checkpoint(log)
            asked = stop()
            if self._somewhere(bool(asked)) and frame <= last:
                return f"interrupted by {asked}" if isinstance(asked, str) and asked else "interrupted"  # "": another rank was asked
        return ""

    def _step(self, end: float) -> dict[str, Value]:
        """Take a step towards a time [s] and return its row of the log."""
        begun = clock.perf_counter()
        stable = self.simulation.stable_dt()
        number = self.simulation.step_count + 1
        if math.isnan(stable):
            raise SimulationFailed(f"step {number}: the stable time step is not a number")
        if stable < self.time.dt_min and not self._below_dt_min:
            self._below_dt_min = True  # once is enough: the log's column cfl has the rest
            self._warn(f"step {number}: the CFL number asks for dt = {stable:.3g} s, below time.dt_min; steps are longer than it allows")
        dt, retries, values = take_step(self.simulation, stable, end, self.time)
        seconds = clock.perf_counter() - begun
        return {
            "step": self.simulation.step_count,
            "time": self.simulation.time,
            "dt": dt,
            **values,
            "retries": retries,
            "seconds": seconds,
        }

    def _frames_done(self) -> int:
        """Return the number of the newest frame whose time is reached; it follows from the time alone."""
        interval = 1.0 / self.time.frames_per_second
        reached = self.simulation.time + SAME_TIME * interval
        frame = min(int(reached / interval), self.time.frame_count)
        if frame > 0 and self.time.frame_time(frame) > reached:
            frame -= 1
        elif frame < self.time.frame_count and self.time.frame_time(frame + 1) <= reached:
            frame += 1
        return frame

    def _frame(self) -> list[Part]:
        """Return what the scene wants to see of the simulation now."""
        output = self.output
        if not (output.particles or output.grid or output.surface or output.volume or self._has_bodies):
            return []
        wanted = {Points: output.particles, Cells: output.grid, Surface: True, Volume: True}
        with self.watch.stage("frames"):
            return [part for part in self.simulation.frame() if wanted[type(part)]]

    def _write_frame(self, index: int, last: int, frame: list[Part]) -> None:
        with self.watch.stage("frames"):
            self.writer.put(index, self.time.frame_time(index), frame)
        self.observer.frame(index, last)

    def _checkpoint_is_due(self) -> bool:
        every, minutes = self.output.checkpoint_every, self.output.checkpoint_minutes
        if every and self.simulation.step_count % every == 0:
            return True
        return minutes is not None and self._somewhere(clock.monotonic() - self._checkpoint_time >= 60.0 * minutes)

    def _write_checkpoint(self, log: Log | None = None) -> None:
        """Write a checkpoint unless there is one of this step; what a run that continues from it expects is on the disk before."""
        step = self.simulation.step_count
        if self._checkpointed == step:
            return
        with self.watch.stage("checkpoints"):
            self.writer.flush()
            if log:
                log.sync()
            file = self.folder.checkpoints.write(Checkpoint(step, self.simulation.time, self.simulation.state()))
            self.folder.checkpoints.prune(self.output.checkpoints_kept)
        self.watch.wrote("checkpoints", file)
        self._checkpointed, self._checkpoint_time = step, clock.monotonic()

    def _write_profile(self) -> None:
        assert self.profile is not None
        self.profile.write(self.folder.path, self.simulation.step_count - self._first_step, self.record.seconds)

    def _count(self) -> None:
        """Bring the record up to date."""
        if self.writer.newest is not None:
            self.record.frames = self.writer.newest
        self.record.steps, self.record.time = self.simulation.step_count, self.simulation.time
        self.record.seconds = round(clock.perf_counter() - self._begun, 3)

    def _write_record(self) -> None:
        self._count()
        self.folder.write_record(self.record)

    def _tell_missed(self) -> None:
        """Say how many steps of this run's went on from a solve that had missed its tolerance."""
        if self._missed:
            (worst, step), steps = max(self._missed), self.simulation.step_count - self._first_step
            left = f": the worst, step {step}, left a residual of {worst:.1e}" * (worst > 0.0)
            self._warn(f"{len(self._missed)} of {steps} steps missed solver.tolerance = {self._tolerance}{left}")

    def _fail(self, reason: str) -> None:
        self.record.status = "failed"
        self.record.reason = reason

    def _try_to(self, write: Callable[[], None]) -> None:
        """Write after a failure; a disk that refuses that too is worth a warning, not another error."""
        try:
            write()
        except OSError as error:
            self._warn(f"could not be written: {error}")

    def _warn(self, text: str) -> None:
        self.record.warnings.append(text)
        self.observer.note(f"warning: {text}")
