"""What frames cost: formats of a grid's cells against each other, and the share of a run's time that its frames take.

python -m warp_lcp.benchmarks.frames 64 96 128 --scene dam-break --set time.duration=0.4
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.frames.atomic import replacing
from warp_lcp.frames.nvdb import write_nvdb
from warp_lcp.frames.vti import write_vti
from warp_lcp.frames.vtu import write_vtu
from warp_lcp.run.loop import RunRequest, run_scene
from warp_lcp.run.profile import Profile
from warp_lcp.scene.scene_file import load_scene
from warp_lcp.simulation import Cells, Volume

SEED = 977
NO_FRAMES = tuple(f"output.{part}=false" for part in ("particles", "grid", "surface", "volume"))


class Nobody:
    """Learn of a run and say nothing."""

    def note(self, text: str) -> None:
        """Do nothing."""

    def start(self, time: float, end: float) -> None:
        """Do nothing."""

    def step(self, row: Mapping[str, Any]) -> None:
        """Do nothing."""

    def frame(self, index: int, last: int) -> None:
        """Do nothing."""


def waves(size: int) -> tuple[Cells, np.ndarray]:
    """Return a wavy pool with a drop above it, 37 of 100 cells, with the fields of a liquid, and its mask over (z, y, x)."""
    x = (np.arange(size) + 0.5) / size
    z, y, x = x[:, None, None], x[None, :, None], x[None, None, :]
    mask = (y < 0.35 + 0.1 * np.sin(6 * x) * np.cos(5 * z)) | ((x - 0.5) ** 2 + (y - 0.7) ** 2 + (z - 0.5) ** 2 < 0.02)
    index = np.argwhere(mask)[:, ::-1]
    rng = np.random.default_rng(SEED)
    fields = {"pressure": rng.random(len(index))}
    fields |= {name: (rng.random(len(index)) < 0.1).astype(np.uint8) for name in ("wall", "released")}
    return Cells("grid", index, 1.0 / size, 3, fields, (size, size, size)), mask


def write_vtkhdf(path: Path, cells: Cells, mask: np.ndarray) -> None:
    """Write cells as a VTKHDF image, the format that VTI was chosen over: it needs h5py."""
    import h5py

    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = (2, 0)
        root.attrs.create("Type", b"ImageData", dtype=h5py.string_dtype("ascii", 9))
        root.attrs["WholeExtent"] = [0, mask.shape[2], 0, mask.shape[1], 0, mask.shape[0]]
        root.attrs["Origin"], root.attrs["Spacing"], root.attrs["Direction"] = (0.0,) * 3, (cells.spacing,) * 3, np.eye(3).ravel()
        data = root.create_group("CellData")
        for name, values in cells.fields.items():
            dense = np.zeros(mask.shape, dtype=values.dtype)
            dense[tuple(cells.index.T[::-1])] = values
            data.create_dataset(name, data=dense)
        data.create_dataset("vtkGhostType", data=np.where(mask, 0, 32).astype(np.uint8))


def format_table(sizes: list[int], repeat: int, folder: Path) -> list[str]:
    """Return lines of a table of milliseconds (the best of `repeat`, turn by turn), megabytes on disk and in memory."""
    lines = ["| cells | format | ms | MB on disk | MB of memory |", "|---|---|---|---|---|"]
    for size in sizes:
        cells, mask = waves(size)
        distance = Volume("level_set", np.where(mask, -1.0, 1.0).astype(np.float32) / size, 1.0 / size, 1.5 / size)
        density = Volume("density", mask.astype(np.float32), 1.0 / size)
        file = folder / "frame"
        writers: dict[str, Callable[[], None]] = {
            "vtu": partial(write_vtu, file, cells),
            "vti": partial(write_vti, file, cells),
            "vtkhdf": partial(write_vtkhdf, file, cells, mask),
            "nvdb, level set": partial(write_nvdb, file, distance),
            "nvdb, density": partial(write_nvdb, file, density),
        }
        best = dict.fromkeys(writers, np.inf)
        for _ in range(repeat):
            for name, write in writers.items():
                begun = time.perf_counter()
                write()
                best[name] = min(best[name], time.perf_counter() - begun)
        for name, write in writers.items():
            tracemalloc.start()
            write()
            memory = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            disk = file.stat().st_size
            lines.append(f"| {len(cells.index):,} of {size}^3 | {name} | {1e3 * best[name]:.1f} | {disk / 1e6:.2f} | {memory / 1e6:.1f} |")
    return lines


def share_table(name: str, overrides: list[str], repeat: int, device: str, folder: Path) -> list[str]:
    """Return lines of a table of the time that a run's frames take: best of `repeat` with and without them, turn by turn.

    The writer's thread waits for the disk most of the time: the processors' time tells what is left for others.
    """
    scenes = {"with": load_scene(name, overrides), "without": load_scene(name, [*overrides, *NO_FRAMES])}
    run_scene(RunRequest(scene=scenes["with"], out=folder / "first", device=device), observer=Nobody())  # loads the kernels
    wall, processors = (dict.fromkeys(scenes, np.inf) for _ in range(2))
    stages = {"frames": np.inf, "frames, written": np.inf}
    for turn in range(repeat):
        for which, scene in scenes.items():
            profile, begun = Profile(device), time.process_time()
            seconds = run_scene(
                RunRequest(scene=scene, out=folder / f"{which}_{turn}", device=device), observer=Nobody(), profile=profile
            ).seconds
            processors[which] = min(processors[which], time.process_time() - begun)
            wall[which] = min(wall[which], seconds)
            if which == "with":
                stages = {stage: min(least, profile.stages[stage].seconds) for stage, least in stages.items()}
    whole = wall["with"]
    return [
        "| frames | run [s] | processors [s] | on the run's thread | on the writer's |",
        "|---|---|---|---|---|",
        f"| with | {whole:.3f} | {processors['with']:.3f} | {' | '.join(f'{seconds / whole:.1%}' for seconds in stages.values())} |",
        f"| without | {wall['without']:.3f} | {processors['without']:.3f} | | |",
        f"| share | {1 - wall['without'] / whole:.1%} | {1 - processors['without'] / processors['with']:.1%} | | |",
    ]


def main() -> None:
    """Print tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sizes", nargs="*", type=int, default=[64])
    parser.add_argument("--scene", help="measure the share of this scene's frames")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.scene:
            lines = share_table(arguments.scene, arguments.overrides, arguments.repeat, arguments.device, Path(folder))
        else:
            lines = format_table(arguments.sizes, arguments.repeat, Path(folder))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
