"""Run a command on all ranks; the root prints; exit codes agree."""

from __future__ import annotations

import atexit
import hashlib
import pickle
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import typer
import warp as wp

from warp_lcp.distributed import launch
from warp_lcp.distributed.collective import Collective, RankFailed
from warp_lcp.distributed.ranks import Ranks, device_of_rank
from warp_lcp.distributed.watchdog import Watchdog
from warp_lcp.files import TableView
from warp_lcp.run.continuation import mesh_digests
from warp_lcp.run.devices import DeviceError, EngineError, devices
from warp_lcp.run.folder import OutputError, RunRecord, mark_ended
from warp_lcp.run.launcher import Launcher
from warp_lcp.run.loop import RunRequest
from warp_lcp.run.profile import Profiler
from warp_lcp.run.progress import Observer
from warp_lcp.run.resolve_scene import ResolvedScene
from warp_lcp.run.terminal import Terminal, print_lines, print_text
from warp_lcp.scene.scene_file import keys
from warp_lcp.scene.table import written
from warp_lcp.simulation import InputError, SimulationFailed, StepFailed

PLANNED = (OSError, InputError, StepFailed, SimulationFailed)
SHOWN = 4  # differences shown in a message
# Seconds for a process to exit at the end, while PETSc and MPI synchronize for the last time.
PARTING = 60


class RankLauncher(Launcher):
    """Launcher that runs a command on all ranks; every method is collective.

    Args:
        ranks: all ranks.
        rank_timeout: longest time that ranks wait for one of them [s]; 0: no limit.
    """

    def __init__(self, ranks: Ranks, rank_timeout: float) -> None:
        """Create a launcher; only the root rank prints messages."""
        super().__init__(Terminal(stderr=True, quiet=not ranks.is_root))
        if not ranks.is_root:
            wp.config.log_level = wp.LOG_ERROR
        self.collective: Collective = Collective(ranks, PLANNED, self._report_abort)
        self.watchdog = self.collective.watchdog = Watchdog(
            ranks, rank_timeout, self.collective.end_all
        )
        self._folder: Path | None = None

    def load(
        self, scene: str | None, overrides: Sequence[str], options: TableView
    ) -> ResolvedScene:
        """Return a scene that is the same on all ranks.

        Raises:
            SceneError: lists all errors.
            OutputError: ranks were started with different scenes or options; the message names the
                difference.
        """
        with self.collective.together():
            given = super().load(scene, overrides, options)
            meshes = {
                f"the content of {key}": value for key, value in mesh_digests(given.scene).items()
            }
        self.agree({**options, **keys(given.scene), **meshes})
        return given

    def choose_device(self, name: str | None) -> str:
        """Return the device of this rank.

        Raises:
            DeviceError: there is no such device.
        """
        devices()  # starts Warp without its native messages
        with self.collective.together():
            try:
                return device_of_rank(self.collective.ranks, name)
            except ValueError as error:
                # The collective operation names the rank.
                raise DeviceError(
                    str(error).removesuffix(f" (rank {self.collective.ranks.rank})")
                ) from error

    def place(self, device: str) -> str:
        """Return the devices of the ranks in words."""
        size = self.collective.ranks.size
        return f"{size} rank{'s' if size > 1 else ''} ({device})"

    def run(
        self,
        request: RunRequest,
        *,
        observer: Observer,
        stop: Callable[[], bool | str],
        profile: Profiler | None,
    ) -> RunRecord:
        """Simulate a scene on all ranks, as `run_scene` does.

        If MPI aborts, run.json records it.
        """
        self._folder = request.out
        return super().run(request, observer=observer, stop=stop, profile=profile)

    def agree(self, arguments: TableView) -> None:
        """Check that all ranks have the same values, by name.

        Raises:
            OutputError: they differ; the message names the difference.
        """
        digests = self.collective.exchange(
            hashlib.blake2b(
                pickle.dumps(sorted(arguments.items(), key=lambda item: item[0]))
            ).digest()
        )
        if digests.count(digests[0]) == len(digests):
            return
        all_values = self.collective.exchange(dict(arguments))
        names = sorted(
            {
                name
                for values in all_values
                for name in values
                if any(other.get(name) != values[name] for other in all_values)
            }
        )
        lines = []
        for name in names[:SHOWN]:
            rank = next(
                r
                for r, values in enumerate(all_values)
                if values.get(name) != all_values[0].get(name)
            )
            lines.append(
                f"{name}: {_shown(all_values[0].get(name))} on rank 0, "
                f"{_shown(all_values[rank].get(name))} on rank {rank}"
            )
        if len(names) > SHOWN:
            lines.append(f"and {len(names) - SHOWN} more")
        raise OutputError(
            "\n  ".join(["the ranks were started with different scenes or options", *lines])
        )

    def _report_abort(self, text: str) -> None:
        """Print why all processes end now, and write it into run.json.

        The root rank cannot do this inside an MPI call.
        """
        print_lines(text, error=True)
        if self._folder is not None:
            lines = text.splitlines()
            who = f"rank {self.collective.ranks.rank}"
            mark_ended(
                self._folder,
                "failed",
                f"{who}: {lines[-2]}" if "Traceback" in lines[0] else lines[0],
            )


@contextmanager
def ranks_together(rank_timeout: float) -> Iterator[RankLauncher]:
    """Run this process's part of a collective command.

    All ranks but the root exit silently, with the root's exit code.

    Args:
        rank_timeout: longest time that ranks wait for one of them [s]; 0: no limit.

    Raises:
        EngineError: MPI or PETSc is missing, or does not match mpiexec.
        typer.Exit: the command has failed; the root rank prints the error.
    """
    try:
        ranks = Ranks.world()
    except ImportError as error:
        if launch.rank_here():
            raise typer.Exit(2) from error
        raise EngineError(f"--engine petsc: {error}") from error
    started = launch.processes_started()
    if started != 1 and ranks.size == 1:
        raise EngineError(
            f"--engine petsc: {started} processes were started, but mpi4py sees only one: the MPI "
            "libraries differ; use the mpiexec "
            "of the MPI that mpi4py was built with, or the matching --mpi option of srun"
        )
    if ranks.size > 1:
        # Python's threads have ended by then: an alarm of the system ends a process that hangs.
        atexit.register(signal.alarm, PARTING)
    try:
        launcher = RankLauncher(ranks, rank_timeout)
        with launcher.watchdog, launcher.collective.together():
            yield launcher
    except RankFailed as error:
        print_text(launcher.console, str(error))
        raise typer.Exit(1) from error
    except PLANNED as error:
        if ranks.is_root:
            raise
        raise typer.Exit(2 if isinstance(error, InputError) else 1) from error


def _shown(value: object) -> str:
    return "nothing" if value is None else written(value)
