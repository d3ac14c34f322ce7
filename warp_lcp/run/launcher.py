"""Who carries out a command: this process alone, or the ranks that started with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_lcp.run.devices import choose_device
from warp_lcp.run.engine import Engine
from warp_lcp.run.folder import OutputError, RunRecord
from warp_lcp.run.given_scene import GivenScene, given_scene, scene_to_resume
from warp_lcp.run.loop import run_scene
from warp_lcp.run.profile import Profile
from warp_lcp.run.progress import Observer
from warp_lcp.run.terminal import Terminal
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import load_scene

if TYPE_CHECKING:
    from warp_lcp.distributed.ranks import Ranks


class Crew:
    """This process alone.

    Attributes:
        console: takes messages.
        speaks: this process tells the user what happens.
    """

    def __init__(self, console: Terminal | None = None, *, speaks: bool = True) -> None:
        """Speak to the error stream."""
        self.console = console or Terminal(stderr=True)
        self.speaks = speaks

    def load(self, scene: str | None, overrides: Sequence[str], options: Mapping[str, Any]) -> GivenScene:
        """Return the scene of a run, or of one that goes on.

        Args:
            scene: as of `load_scene`; None: that of the folder.
            overrides: as of `load_scene`.
            options: of the command, by their names.

        Raises:
            OutputError: there is no run to go on with.
            SceneError: listing everything that is wrong.
        """
        out = options.get("--out")
        if not options.get("--resume"):
            if scene is None:
                raise OutputError("SCENE is missing: a scene file or the name of a built-in one; --resume --out DIR goes on without")
            return given_scene(scene, overrides)
        if out is None and scene is None:
            raise OutputError("--resume: needs SCENE or --out DIR, the folder of the run")
        return scene_to_resume(out or default_folder(load_scene(scene or "", overrides)), scene, overrides)

    def agree(self, given: Mapping[str, Any]) -> None:
        """Check that all were given the same values, by their names.

        Raises:
            OutputError: they were not; the message names what differs.
        """

    @property
    def ranks(self) -> Ranks | None:
        """Who share the work; None if this process has it alone."""
        return None

    def choose_device(self, name: str | None) -> str:
        """Return the device of this process.

        Raises:
            DeviceError: there is no such device.
        """
        return choose_device(name)

    def place(self, device: str) -> str:
        """Return where the crew works, in words.

        Args:
            device: of this process.
        """
        return device

    def run(
        self,
        given: GivenScene,
        out: Path,
        *,
        device: str,
        observer: Observer,
        last_frame: int | None,
        resume: bool,
        force: bool,
        force_memory: bool,
        stop: Callable[[], bool | str],
        profile: Profile | None,
        record_problems: Path | None,
    ) -> RunRecord:
        """Simulate a scene that `load` returned, as `run_scene` does.

        Raises:
            OutputError: the folder cannot take the run.
            SceneError: the scene cannot be simulated.
        """
        return run_scene(
            given.scene, out, overrides=given.overrides, device=device, observer=observer, last_frame=last_frame, resume=resume,
            force=force, force_memory=force_memory, stop=stop, profile=profile, record_problems=record_problems,
        )  # fmt: skip


def default_folder(scene: Scene) -> Path:
    """Return the folder of a scene's run where none is given."""
    return Path("out") / scene.scene.name


@contextmanager
def crew_of(engine: Engine) -> Iterator[Crew]:
    """Give who carries out a command.

    Raises:
        EngineError: the engine cannot be used here.
    """
    if engine is Engine.SINGLE:
        yield Crew()
        return
    from warp_lcp.run.rank_launcher import ranks_together  # needs MPI and PETSc

    with ranks_together() as crew:
        yield crew
