"""Python API: step a run frame by frame, with callbacks."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
import warp as wp

from warp_lcp.files import TableView
from warp_lcp.frames.meshio_format import to_meshio
from warp_lcp.grid.particles import Particles
from warp_lcp.material.add_material import pour
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.rigid.body import RigidBody
from warp_lcp.run.devices import choose_device
from warp_lcp.run.folder import RunRecord
from warp_lcp.run.interruption import Interruption
from warp_lcp.run.log import Value
from warp_lcp.run.loop import RunLoop, RunRequest, running_scene
from warp_lcp.run.resolve_scene import ResolvedScene, resolve_scene, scene_to_resume
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import SceneSource, load_scene, single_tables
from warp_lcp.scene.table import KeyFault, SceneError
from warp_lcp.settings import nearest
from warp_lcp.simulation import InputError, Part, Simulation, SimulationFailed, VolumeGroup

if TYPE_CHECKING:
    import meshio


class RunError(InputError):
    """Wrong argument of a run in Python.

    The message names the argument and what is allowed.
    """


@dataclass(frozen=True)
class Frame:
    """Frame of a run: the simulation's own arrays, without copies.

    They are valid until the run continues.

    Args:
        index: number of the frame, 0 at the start.
        time: time of the simulation [s].
        row: the last step's log row, by column; empty before the first step.
        simulation: the simulation.
    """

    index: int
    time: float
    row: Mapping[str, Value]
    simulation: Simulation

    @property
    def particles(self) -> Particles:
        """Arrays of the particles, without spray: Warp arrays, wp.vec3, shape (count,).

        `position` [m], `velocity` [m/s] and `affine`.
        """
        return _of_particles(self.simulation).particles

    @property
    def ids(self) -> np.ndarray:
        """Ids of `particles`, int64, shape (count,).

        Raises:
            RunError: the scene's `output.ids` is false.
        """
        return self._identified(_of_particles(self.simulation).ids)

    @property
    def ages(self) -> np.ndarray:
        """Ages of `particles` [s], float32, shape (count,).

        Raises:
            RunError: the scene's `output.ids` is false.
        """
        return self._identified(_of_particles(self.simulation).ages)

    @staticmethod
    def _identified(values: np.ndarray | None) -> np.ndarray:
        if values is None:
            raise RunError("particles have no ids: set output.ids = true")
        return values

    @property
    def bodies(self) -> Sequence[RigidBody]:
        """Rigid bodies in the order of their solids.

        `position` [m], `velocity`, `rotation`, `angular_velocity`, `momentum`.
        """
        bodies = _of_particles(self.simulation).bodies
        return bodies.bodies if bodies is not None else ()

    @property
    def fields(self) -> dict[str, wp.array]:
        """Velocity on the faces of the grid, `velocity_x` to `velocity_z` [m/s].

        Shape (nz + 2, ny + 2, nx + 2), with a ring of cells around the domain. Entry [k, j, i]
        belongs to the lower face of cell (i - 1, j - 1, k - 1) along the axis.
        """
        faces = _of_particles(self.simulation).velocity
        return {f"velocity_{axis}": field for axis, field in zip("xyz", faces, strict=False)}

    def to_meshio(self) -> dict[str, meshio.Mesh]:
        """Return a `meshio.Mesh` for each part of the frame, by name.

        Points [m], cells, and the fields as point data or cell data. The parts are `particles`,
        `grid` (its cells are quadrilaterals or hexahedra), and `surface`, `bodies`, `level_set`,
        `density` and `velocity` if the scene has them. Of volumes only the cells within the level
        set's band, or with a density or velocity other than 0, are included.
        """
        found: dict[str, meshio.Mesh] = {}
        for part in self.parts():
            members = part.volumes if isinstance(part, VolumeGroup) else (part,)
            found |= {member.name: to_meshio(member) for member in members}
        return found

    def parts(self) -> list[Part]:
        """Return copies of the parts that a frame's files contain.

        Points, cells with pressure, and surfaces and volumes if the scene requests them.
        """
        return self.simulation.frame()


class Run:
    """A run of a scene, stepped from Python.

    `for frame in run` runs the steps from one frame to the next. They are the same as those of
    `warp-lcp run`, and with a `folder` so are log, frames and checkpoints, bit for bit. When the
    loop ends early, with `break`, by an error in it or by Ctrl-C, the run is stopped with a
    checkpoint, from which `Run.resume` continues. Ctrl-C waits for the end of the current step and
    is then raised as usual; a second Ctrl-C does not wait.

    Args:
        scene: a scene file, the name of a built-in scene, its tables as a dict, or a Scene.
        folder: folder for log, frames and checkpoints; no files are written if None.
        device: a Warp device; default: a GPU, if there is one.
        frames: stop after this frame; default: the last one of the scene.
        force: delete an existing run in the folder.
        on_step: called after each step, as by `on_step`.
        overrides: keys of the scene with new values, such as {"domain.resolution": 96,
            "liquid.0.max": [1, 1]}.
        keys: the same, without the name of the table, for keys that only one table has:
            `resolution=96`.

    Attributes:
        scene: the scene.
        record: record of the run, as in run.json.

    Raises:
        SceneError: the scene is invalid; the message lists all errors.
        RunError: an argument is wrong.
        DeviceError: there is no such device.
    """

    def __init__(
        self,
        scene: SceneSource,
        *,
        folder: str | PathLike[str] | None = None,
        device: str | None = None,
        frames: int | None = None,
        force: bool = False,
        on_step: Callable[[Run], object] | None = None,
        overrides: TableView | None = None,
        **keys: object,
    ) -> None:
        """Load the scene; build and write nothing before the first frame."""
        given = resolve_scene(scene, _overrides(scene, overrides, keys))
        self._set_up(
            given,
            RunRequest(scene=given.scene, out=_folder(folder), force=force),
            device,
            frames,
            on_step,
        )

    @classmethod
    def resume(
        cls,
        folder: str | PathLike[str],
        *,
        device: str | None = None,
        frames: int | None = None,
        on_step: Callable[[Run], object] | None = None,
        overrides: TableView | None = None,
        **keys: object,
    ) -> Self:
        """Return the run of a folder, continued from its newest checkpoint.

        The next frame is the first one without a file; arguments as of `Run`. Changes made by
        callbacks are in the checkpoint, except gravity, which is that of the scene.

        Raises:
            OutputError: there is no run in the folder.
        """
        path, run = _folder(folder), cls.__new__(cls)
        if path is None:
            raise RunError("folder: must be the folder of a run, not None")
        scene = path / "scene.toml"
        given = scene_to_resume(
            path, None, _overrides(scene, overrides, keys) if overrides or keys else ()
        )
        run._set_up(
            given, RunRequest(scene=given.scene, out=path, resume=True), device, frames, on_step
        )
        return run

    def _set_up(
        self,
        resolved: ResolvedScene,
        request: RunRequest,
        device: str | None,
        frames: int | None,
        on_step: Callable[[Run], object] | None,
    ) -> None:
        """Check the arguments and initialize the run."""
        if frames is not None and (
            not isinstance(frames, int) or isinstance(frames, bool) or frames < 0
        ):
            raise RunError(f"frames = {frames!r}: must be a whole number of at least 0, or None")
        self.scene: Scene = resolved.scene
        self.row: Mapping[str, Value] = {}
        self.notes: list[str] = []
        self._request = replace(
            request, device=choose_device(device), overrides=resolved.overrides, last_frame=frames
        )
        self._callbacks: list[Callable[[Run], object]] = []
        self._stopped, self._used, self._loop, self._index = "", False, None, -1
        self.record: RunRecord | None = None
        if on_step is not None:
            self.on_step(on_step)

    _loop: RunLoop | None

    def on_step(self, callback: Callable[[Run], object]) -> Callable[[Run], object]:
        """Register a callback that is called with the run after each step.

        It is called before the frame and the checkpoint of that time are written. It can be used as
        a decorator.

        The callback may read `run.row`, `run.time` and `run.simulation`, `push` a body, change
        `gravity`, `add` material and `stop` the run. An error that it raises ends the run with a
        checkpoint of the step; `Run.resume` continues, first with the frame if the step ends one.

        Raises:
            RunError: it is not callable.
        """
        if not callable(callback):
            raise RunError(f"on_step: must be a function of the run, not {type(callback).__name__}")
        self._callbacks.append(callback)
        return callback

    def __iter__(self) -> Iterator[Frame]:
        """Simulate, and yield each frame when its time is reached.

        Raises:
            OutputError: the folder cannot be used for the run.
            SceneError: the scene cannot be simulated.
            SimulationFailed: the run has failed; the message is the reason in run.json.
            KeyboardInterrupt: Ctrl-C was pressed; the run has been stopped, with a checkpoint.
        """
        if self._used:
            raise RunError(
                "this run was iterated already; use Run.resume(folder) to continue, or a new Run "
                "to start again"
            )
        self._used = True
        interruption = Interruption(self.notes.append, signals=[signal.SIGINT])
        running = running_scene(
            self._request, observer=_Callbacks(self), stop=lambda: interruption() or self._stopped
        )
        try:
            self._loop = next(running)
            self.record = self._loop.record
            while self._goes_on(running, interruption):
                yield Frame(self._index, self.simulation.time, self.row, self.simulation)
        finally:
            running.close()
        if interruption.name:
            signal.raise_signal(signal.SIGINT)
        if self.record.status == "failed":
            raise SimulationFailed(self.record.reason)

    def _goes_on(self, running: Iterator[RunLoop], interruption: Interruption) -> bool:
        """Run the steps to the next frame; return whether there is one.

        In the main thread Ctrl-C waits for the end of the step.
        """
        is_main = threading.current_thread() is threading.main_thread()
        with interruption if is_main else nullcontext():
            goes_on = next(running, None) is not None
            # The step has ended a frame; the loop reads the stop request after it.
            while goes_on and interruption.name:
                goes_on = next(running, None) is not None
            return goes_on

    def finish(self) -> RunRecord:
        """Run to the last frame and return the record of the run.

        Raises:
            SimulationFailed: the run has failed.
        """
        for _ in self:
            pass
        assert self.record is not None
        return self.record

    @property
    def simulation(self) -> Simulation:
        """Simulation, from the first frame on.

        Raises:
            RunError: the run has not begun.
        """
        if self._loop is None:
            raise RunError("the run has not started: the simulation exists from the first frame on")
        return self._loop.simulation

    @property
    def time(self) -> float:
        """Time of the simulation [s]."""
        return self.simulation.time

    @property
    def gravity(self) -> np.ndarray:
        """Gravity [m/s^2], a copy, shape (3,).

        Set it with as many numbers as the scene has dimensions. Limits that the pressure of liquids
        derives from gravity are still computed from the scene's gravity.
        """
        return _of_particles(self.simulation).gravity.copy()

    @gravity.setter
    def gravity(self, value: Sequence[float]) -> None:
        _of_particles(self.simulation).gravity[:] = self._vector("gravity", value)

    def push(
        self, body: int, impulse: Sequence[float], *, at: Sequence[float] | None = None
    ) -> None:
        """Apply an impulse to a rigid body.

        Args:
            body: its number, counted from 0 in the order of the scene's solids.
            impulse: [N s; N s/m in 2-D].
            at: point of application [m]; default: the center of mass.

        Raises:
            RunError: there is no such body, or a vector is not finite or of another dimension.
        """
        bodies = _of_particles(self.simulation).bodies
        rigid_bodies = bodies.bodies if bodies is not None else []
        if not isinstance(body, (int, np.integer)) or not 0 <= body < len(rigid_bodies):
            raise RunError(
                f"body = {body!r}: "
                + (
                    f"must be from 0 to {len(rigid_bodies) - 1}"
                    if rigid_bodies
                    else "the scene has no rigid bodies"
                )
            )
        pushed, given = rigid_bodies[body], self._vector("impulse", impulse)
        arm = np.zeros(3) if at is None else self._vector("at", at) - pushed.position
        pushed.push(np.concatenate([given, np.cross(arm, given)]))

    def add(self, **shape: object) -> int:
        """Add material, at rest or with a `velocity`, outside material and solids.

        Returns the number of new particles.

        Args:
            shape: the keys of an entry of the scene's `[[liquid]]` or `[[sand]]`, such as
                shape="box", min=[0, 1], max=[1, 2].

        Raises:
            SceneError: a key is invalid.
            RunError: there is no room.
        """
        simulation = _of_particles(self.simulation)
        table = simulation.scene.materials()[0]
        data = self.scene.model_dump(by_alias=True, exclude_none=True)
        data[table] = [*data.get(table, []), shape]
        entries = load_scene(data).materials()[1]
        try:
            return pour(
                simulation, entries[-1], f"{table}[{len(entries) - 1}] ({entries[-1].shape})"
            )
        except ValueError as error:
            raise RunError(f"add: {error}") from error

    def stop(self) -> None:
        """Stop the run after the current step, with a checkpoint."""
        self._stopped = "its program"

    def _vector(self, name: str, value: Sequence[float]) -> np.ndarray:
        """Return a vector of the scene's dimension, in the unit of its values, shape (3,)."""
        try:
            given = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            given = np.zeros(0)
        if given.shape != (self.scene.dimension,) or not np.isfinite(given).all():
            raise RunError(f"{name} = {value!r}: must be {self.scene.dimension} finite numbers")
        return np.array([*given, 0.0][:3])


class _Callbacks:
    """Observer of a run that is driven from Python.

    Args:
        run: the run, whose callbacks are called.
    """

    def __init__(self, run: Run) -> None:
        self._run = run

    def note(self, text: str) -> None:
        """Store a remark."""
        self._run.notes.append(text)

    def start(self, time: float, end: float) -> None:
        """Do nothing."""

    def step(self, row: Mapping[str, Value]) -> None:
        """Pass the step to the callbacks."""
        self._run.row = row
        for callback in self._run._callbacks:
            callback(self._run)

    def frame(self, index: int, last: int) -> None:
        """Store the number of the current frame."""
        self._run._index = index


def _of_particles(simulation: Simulation) -> ParticleSimulation:
    if not isinstance(simulation, ParticleSimulation):
        raise RunError(
            f"{type(simulation).__name__} has no particles; use its `state()` or `frame()`"
        )
    return simulation


def _folder(folder: str | PathLike[str] | None) -> Path | None:
    try:
        return None if folder is None else Path(folder)
    except TypeError as error:
        raise RunError(f"folder = {folder!r}: must be a path, or None for none") from error


def _overrides(scene: SceneSource, overrides: TableView | None, keys: TableView) -> list[str]:
    """Return overrides in the format of `load_scene`.

    The tables of those in `keys` are looked up.
    """
    tables = single_tables(scene) if keys else {}
    values = dict(overrides or {})
    for key, value in keys.items():
        owners = [table for table, names in tables.items() if key in names]
        if len(owners) != 1:
            known = [name for names in tables.values() for name in names]
            which = (
                f"is a key of {', '.join(owners)}: write TABLE.{key} in `overrides`"
                if owners
                else f"no such key; {nearest(key, known)}"
            )
            raise SceneError("Run", [KeyFault(key, which)])
        values[f"{owners[0]}.{key}"] = value
    return [f"{key}={_written(key, value)}" for key, value in values.items()]


def _written(key: str, value: object) -> str:
    """Return a value as TOML."""
    plain = (
        value.tolist()
        if isinstance(value, (np.ndarray, np.generic))
        else str(value)
        if isinstance(value, Path)
        else value
    )
    try:
        return json.dumps(plain, ensure_ascii=False)
    except TypeError as error:
        raise RunError(
            f"{key}: must be a number, a string, true, false or a list of them, not "
            f"{type(value).__name__}"
        ) from error
