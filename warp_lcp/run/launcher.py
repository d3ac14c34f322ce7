"""Launcher of a command: one process, or the ranks started together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from warp_lcp.files import TableView
from warp_lcp.run.devices import choose_device
from warp_lcp.run.folder import OutputError, RunRecord
from warp_lcp.run.loop import RunRequest, run_scene
from warp_lcp.run.profile import Profiler
from warp_lcp.run.progress import Observer
from warp_lcp.run.resolve_scene import ResolvedScene, resolve_scene, scene_to_resume
from warp_lcp.run.terminal import Terminal
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import load_scene

if TYPE_CHECKING:
    from warp_lcp.distributed.collective import Collective
    from warp_lcp.distributed.ranks import Ranks


class Launcher:
    """Launcher that runs a command in this process alone.

    Attributes:
        console: console for messages; on ranks, for those of the root rank.
        collective: collective operations of the ranks that share the work; None for one process.
    """

    collective: Collective | None = None

    def __init__(self, console: Terminal | None = None) -> None:
        """Create a launcher; without a console, messages go to the error stream."""
        self.console = console or Terminal(stderr=True)

    @property
    def is_root(self) -> bool:
        """Whether this process prints messages."""
        return self.collective is None or self.collective.ranks.is_root

    @property
    def ranks(self) -> Ranks | None:
        """MPI ranks; None for a single process."""
        return self.collective.ranks if self.collective else None

    def load(
        self, scene: str | None, overrides: Sequence[str], options: TableView
    ) -> ResolvedScene:
        """Return the scene of a new or resumed run.

        Args:
            scene: see `load_scene`; that of the folder if None.
            overrides: see `load_scene`.
            options: options of the command, by name.

        Raises:
            OutputError: there is no run to resume.
            SceneError: lists all errors.
        """
        out = options.get("--out")
        if not options.get("--resume"):
            if scene is None:
                raise OutputError(
                    "SCENE is missing: give a scene file or the name of a built-in scene; only "
                    "--resume --out DIR needs none"
                )
            return resolve_scene(scene, overrides)
        if out is None and scene is None:
            raise OutputError("--resume: needs SCENE or --out DIR, the folder of the run")
        return scene_to_resume(
            out or default_folder(load_scene(scene or "", overrides)), scene, overrides
        )

    def agree(self, given: TableView) -> None:
        """Check that all ranks have the same values, by name.

        Raises:
            OutputError: they differ; the message names the difference.
        """

    def choose_device(self, name: str | None) -> str:
        """Return the device of this process.

        Raises:
            DeviceError: there is no such device.
        """
        return choose_device(name)

    def place(self, device: str) -> str:
        """Return the device in words.

        Args:
            device: device of this process.
        """
        return device

    def run(
        self,
        request: RunRequest,
        *,
        observer: Observer,
        stop: Callable[[], bool | str],
        profile: Profiler | None,
    ) -> RunRecord:
        """Simulate a scene that `load` returned, as `run_scene` does.

        Raises:
            OutputError: the folder cannot be used for the run.
            SceneError: the scene cannot be simulated.
        """
        return run_scene(
            request, observer=observer, stop=stop, profile=profile, collective=self.collective
        )


def default_folder(scene: Scene) -> Path:
    """Return the default folder of a scene's run."""
    return Path("out") / scene.scene.name
