"""Hand-written run folders with surfaces and bodies, for tests of images."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.run.folder import RunRecord
from warp_lcp.run.loop import RunRequest, run_scene
from warp_lcp.run.progress import Observer, ProgressLines
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import dump_scene, load_scene
from warp_lcp.simulation import Part, Surface

MINIMAL = """
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


def run_into(
    scene: Scene, out: Path, *, observer: Observer | None = None, **options: Any
) -> RunRecord:
    """Run a scene into a folder on the CPU.

    Options are those of a RunRequest or of `run_scene`.
    """
    defaults = {
        name: options.pop(name)
        for name in ("last_frame", "resume", "force", "force_memory", "record_problems")
        if name in options
    }
    return run_scene(
        RunRequest(scene=scene, out=out, **defaults),
        observer=observer or ProgressLines(Console(quiet=True)),
        **options,
    )


def run_scene_file(scene: Path, out: Path, *overrides: str, **options: Any) -> RunRecord:
    """Run the scene of a file with overrides into a folder; options as of `run_into`."""
    return run_into(load_scene(scene, overrides), out, **options)


def write_run(
    folder: Path, frames: Sequence[list[Part]], text: str = "", size: Sequence[float] = (1.0, 1.0)
) -> Path:
    """Write a run of the simulator `dots`.

    It has 10 cells along a side of 1 m, and 20 frames per second.
    """
    folder.mkdir()
    source = folder / "source.toml"
    source.write_text(
        '[scene]\nsimulator = "dots"\nname = "drops"\n[time]\nduration = 1.0\nframes_per_second = '
        "20\n"
        f'[domain]\nsize = {list(size)}\nresolution = 10\nsolids = "cut-cell"\n{text}'
    )
    (folder / "scene.toml").write_text(dump_scene(load_scene(source)))
    writer = FrameFolder(folder)
    for index, parts in enumerate(frames):
        writer.write(index, index / 20, parts)
    return folder


def ball(
    center: Sequence[float], radius: float, name: str = "surface", body: int | None = None
) -> Surface:
    """Return a sphere of triangles, in 2-D (two coordinates) a circle.

    Triangles are counterclockwise seen from outside; a circle has its inside on the left.
    """
    if len(center) == 2:
        angle = np.linspace(0.0, 2.0 * np.pi, 97)[:-1]
        points = np.stack(
            [center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle), np.zeros(96)],
            axis=-1,
        )
        corners = np.stack([np.arange(96), np.roll(np.arange(96), -1)], axis=-1)
    else:
        points, corners = sphere()
        points = np.asarray(center) + radius * points
    fields = {"velocity": np.zeros_like(points)}
    if body is not None:
        fields["body"] = np.full(len(points), body, dtype=np.int32)
    return Surface(name, points.astype(np.float32), corners.astype(np.int32), fields)


def box(low: Sequence[float], high: Sequence[float], name: str = "surface") -> Surface:
    """Return a box of twelve triangles.

    Its corners belong to one side each, so that its normals are those of the sides.
    """
    points, corners = [], []
    for axis in range(3):
        for side in range(2):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            quad = np.zeros((4, 3))
            quad[:, axis] = (low, high)[side][axis]
            quad[:, u] = np.array([low[u], high[u], high[u], low[u]])
            quad[:, v] = np.array([low[v], low[v], high[v], high[v]])
            order = np.array([[0, 1, 2], [0, 2, 3]]) if side else np.array([[0, 2, 1], [0, 3, 2]])
            corners.append(order + len(points))
            points.extend(quad)
    return Surface(
        name, np.array(points, dtype=np.float32), np.concatenate(corners).astype(np.int32)
    )


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Return a unit sphere: an octahedron whose triangles are divided four times."""
    points = [tuple(row) for sign in (1.0, -1.0) for row in sign * np.eye(3)]
    corners = [
        (0, 1, 2),
        (1, 3, 2),
        (3, 4, 2),
        (4, 0, 2),
        (1, 0, 5),
        (3, 1, 5),
        (4, 3, 5),
        (0, 4, 5),
    ]
    for _ in range(4):
        number = {point: index for index, point in enumerate(points)}
        divided = []
        for a, b, c in corners:
            middles = []
            for p, q in ((a, b), (b, c), (c, a)):
                middle = np.add(points[p], points[q])
                key = tuple(np.round(middle / np.linalg.norm(middle), 12))
                if key not in number:
                    number[key] = len(points)
                    points.append(key)
                middles.append(number[key])
            ab, bc, ca = middles
            divided += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = divided
    return np.array(points), np.array(corners)


def read_record(folder: Path) -> dict[str, Any]:
    """Return what `run.json` in a run's folder holds."""
    return json.loads((folder / "run.json").read_text())


def run_contents(folder: Path) -> dict[str, Any]:
    """Return what equal runs have in common.

    They are frames, collections, the log without seconds, the scene, and the arrays of checkpoints.
    """
    files = [*folder.glob("frames/*"), *folder.glob("*.pvd"), folder / "scene.toml"]
    found: dict[str, Any] = {str(p.relative_to(folder)): p.read_bytes() for p in files}
    with open(folder / "log.csv", newline="") as file:
        found["log"] = [
            {key: value for key, value in row.items() if key != "seconds"}
            for row in csv.DictReader(file)
        ]
    for path in folder.glob("checkpoints/step_*.npz"):
        found[path.name] = {name: array.tobytes() for name, array in np.load(path).items()}
    return found


def written_files(folder: Path) -> dict[str, bytes]:
    """Return frames, collections and the last checkpoint of a run by name."""
    files = [
        *folder.glob("frames/*"),
        *folder.glob("*.pvd"),
        sorted(folder.glob("checkpoints/*.npz"))[-1],
    ]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


class StepCounter:
    """An observer that counts steps."""

    def __init__(self) -> None:
        self.steps = 0

    def note(self, text: str) -> None:
        assert text

    def start(self, time: float, end: float) -> None:
        assert end > time

    def step(self, row: dict[str, Any]) -> None:
        self.steps += 1

    def frame(self, index: int, last: int) -> None:
        assert index <= last
