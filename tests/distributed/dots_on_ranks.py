"""Command line with a simulator of falling dots on several ranks.

NumPy only, with failures on request. Several commands may follow each other, with `then` between
them. Their exit codes go to the error stream; that of the last is the program's. A command may
begin with DOTS_TROUBLE="step rank kind", the failure (see `trouble`), and DOTS_REFUSE, the reason
why there is no simulation.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from warp_lcp.cli import commands as cli
from warp_lcp.distributed import collective
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.frames import frame_folder
from warp_lcp.scene import simulator as plug_ins
from warp_lcp.scene.scene import Scene
from warp_lcp.simulation import Cells, Points, SimulationFailed, StepFailed

SCENE = """
[scene]
simulator = "dots"
[time]
duration = 0.5
frames_per_second = 20
dt_max = 0.02
[domain]
size = [1.0, 1.0]
resolution = 8
[output]
checkpoint_every = 4
"""
COUNT, CELLS = 200, 8


class DotsOnRanks:
    """Dots that fall, bounce and drift; a rank owns those in its columns of cells."""

    def __init__(self, scene: Scene, ranks: Ranks) -> None:
        self.ranks, self.time, self.step_count = ranks, 0.0, 0
        self.gravity = np.array(scene.physics.gravity)
        self.low, self.high = (CELLS * (ranks.rank + side) // ranks.size for side in range(2))
        random = np.random.default_rng(7321)
        everyone = random.random((COUNT, 2)), random.standard_normal((COUNT, 2)), np.arange(COUNT)
        self._take(*everyone)

    def stable_dt(self) -> float:
        return 0.02 / (1.0 + float(self.ranks.max(np.abs(self.velocity).max(initial=0.0))))

    def step(self, dt: float) -> dict[str, float | int | str | None]:
        trouble(self)
        self.velocity += dt * self.gravity
        self.position += dt * self.velocity
        for side in (self.position < 0.0, self.position > 1.0):
            self.velocity[side] *= -0.7
        self.position = np.abs(self.position)
        self.position = np.where(self.position > 1.0, 2.0 - self.position, self.position)
        mine = self.position, self.velocity, self.identity
        if self.ranks.size > 1:
            mine = tuple(map(np.concatenate, zip(*self.ranks.comm.allgather(mine), strict=True)))
        self._take(*mine)
        self.time += dt
        self.step_count += 1
        fastest = float(self.ranks.max(np.abs(self.velocity).max(initial=0.0)))
        return {
            "max_speed": fastest,
            "height": self.ranks.sum(self.position[:, 1].sum()) / COUNT,
            "dots": self.ranks.sum(len(self.identity)),
        }

    def columns(self) -> tuple[str, ...]:
        return ("max_speed", "height", "dots")

    def frame(self) -> list[Points | Cells]:
        points = np.pad(self.position, ((0, 0), (0, 1))).astype(np.float32)
        index = np.unique(np.clip(points * CELLS, 0, CELLS - 1).astype(np.int32), axis=0)
        fields = {"velocity": np.pad(self.velocity, ((0, 0), (0, 1))), "identity": self.identity}
        return [
            Points("particles", points, fields),
            Cells("grid", index, 1.0 / CELLS, 2, {"wall": index[:, 1] == 0}, (CELLS, CELLS, 1)),
        ]

    def state(self) -> dict[str, np.ndarray]:
        box = np.array([[self.low, 0, 0], [self.high, CELLS, 1]])
        clock = {"time": np.array(self.time), "step_count": np.array(self.step_count)}
        return {
            "box": box,
            "position": self.position,
            "velocity": self.velocity,
            "identity": self.identity,
            **clock,
        }

    def restore_pieces(self, pieces: list[dict[str, np.ndarray]]) -> None:
        names = "position", "velocity", "identity"
        self._take(*(np.concatenate([piece[name] for piece in pieces]) for name in names))
        self.time, self.step_count = float(pieces[0]["time"]), int(pieces[0]["step_count"])

    def restore(self, state: dict[str, np.ndarray]) -> None:
        self.restore_pieces([state])

    def notes(self) -> list[str]:
        return [f"{COUNT} dots"]

    def _take(self, position: np.ndarray, velocity: np.ndarray, identity: np.ndarray) -> None:
        column = np.minimum((CELLS * position[:, 0]).astype(int), CELLS - 1)
        mine = np.flatnonzero((column >= self.low) & (column < self.high))
        mine = mine[np.argsort(identity[mine])]
        self.position, self.velocity, self.identity = (
            position[mine].copy(),
            velocity[mine].copy(),
            identity[mine].copy(),
        )


class DotsOnRanksSimulator:
    """Plug-in of the simulator."""

    name = "dots"
    summary = "dots that fall, on ranks too"
    scene_model = Scene

    def create(
        self, scene: Scene, *, device: str, folder: Path, ranks: Ranks | None = None
    ) -> DotsOnRanks:
        if ranks is None:
            return DotsOnRanks(scene, Ranks(SimpleNamespace(rank=0, size=1)))
        if os.environ.get("DOTS_REFUSE"):
            raise ValueError(os.environ["DOTS_REFUSE"].format(rank=ranks.rank))
        return DotsOnRanks(scene, ranks)


def trouble(dots: DotsOnRanks) -> None:
    """Let a step fail on one rank, or on all ("-1")."""
    step, rank, kind = (os.environ.get("DOTS_TROUBLE") or "0 0 nothing").split()
    if dots.step_count + 1 != int(step) or int(rank) not in (-1, dots.ranks.rank):
        return
    if kind == "failed":
        raise SimulationFailed(f"step {step}: velocity is not finite")
    if kind == "missed":
        raise StepFailed("the solve missed its criteria")
    if kind == "bug":
        {}["no such key"]
    if kind == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "interrupted":
        os.kill(os.getpid(), signal.SIGTERM)
    if kind == "disk":  # from now on

        def full(*arguments: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        frame_folder.FrameFolder.write_part = full


def main(words: list[str]) -> None:
    """Run commands of the command line with this simulator alone."""
    plug_ins.entry_points = lambda group: [SimpleNamespace(name="dots", load=DotsOnRanksSimulator)]
    collective.PATIENCE = 1.0
    while words:
        end = words.index("then") if "then" in words else len(words)
        command, words = words[:end], words[end + 1 :]
        for name in ("DOTS_TROUBLE", "DOTS_REFUSE"):
            os.environ[name] = ""
        while "=" in command[0]:
            name, os.environ[name] = command.pop(0).split("=")
        try:
            cli.app(command)
        except SystemExit as end_of_command:
            sys.stderr.write(f"exit code {end_of_command.code}\n")
            if not words:
                raise


if __name__ == "__main__":
    main(sys.argv[1:])
