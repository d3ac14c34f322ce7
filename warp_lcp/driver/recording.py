"""The frames of a run, read back for its images, and the color scale that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, cast

import meshio
import numpy as np

from warp_lcp.driver.frames import FRAME_FILE
from warp_lcp.driver.scene import Scene
from warp_lcp.driver.scene_file import check_shapes, load_scene

SCALE_FRAMES = 16  # evenly spaced frames that fix the color scale of a run
SCALE_VALUES = 50_000  # about how many values of each
ROUND_NUMBERS = np.array([1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0])
PALETTES = {  # of speeds, by `Scene.palette`
    "water": np.array([[14, 62, 138], [22, 106, 190], [58, 160, 224], [130, 208, 240], [206, 240, 250]]),
    "sand": np.array([[138, 92, 48], [178, 128, 72], [212, 170, 108], [236, 208, 156], [252, 242, 216]]),
}
VIRIDIS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]])


class RenderError(ValueError):
    """Nothing can be drawn; the message says why and what to do."""


class Color(StrEnum):
    """What the color of a particle means."""

    SPEED = "speed"
    PRESSURE = "pressure"
    FRACTION = "fraction"
    YIELD_RATIO = "yield_ratio"
    PLAIN = "plain"


LABELS = {Color.FRACTION: "fraction of grains", Color.YIELD_RATIO: "yield ratio"}  # what sand's particles know besides


@dataclass(frozen=True)
class Scale:
    """Colors from `low` to `high`, the same in every image of a run; a scale without a label has no legend.

    Args:
        label: quantity and unit.
        low: the value of the first color.
        high: the value of the last color.
        stops: colors, red, green and blue from 0 to 255, shape (m, 3), evenly spaced.
    """

    label: str
    low: float
    high: float
    stops: np.ndarray

    def colors(self, values: np.ndarray) -> np.ndarray:
        """Return a color for each value, 0 to 255, shape (n, 3)."""
        at = (values - self.low) / (self.high - self.low) * (len(self.stops) - 1)
        return np.stack([np.interp(at, np.arange(len(self.stops)), channel) for channel in self.stops.T], axis=-1)


class Recording:
    """The frames that a run wrote, to be read back.

    Args:
        folder: of the run.
        color: what is to be read besides the positions.

    Raises:
        RenderError: the folder is no run's, or has no such frames.
        SceneError: its scene cannot be read.
    """

    def __init__(self, folder: Path, color: Color) -> None:
        """Look which frames there are."""
        if not (folder / "scene.toml").is_file():
            why = "it has no scene.toml" if folder.is_dir() else "there is no such folder"
            raise RenderError(f"{folder}: is not the folder of a run: {why}")
        self.folder = folder
        self.color = color
        self.scene: Scene = load_scene(folder / "scene.toml")
        check_shapes(self.scene, str(folder / "scene.toml"))
        self.numbers = self._numbers("particles")
        if not self.numbers:
            why = "" if self.scene.output.particles else "; the scene's output.particles is false"
            raise RenderError(f"{folder}: holds no frames of particles{why}")
        if color is Color.PRESSURE and not set(self.numbers) <= set(self._numbers("grid")):
            raise RenderError(f"{folder}: --color pressure needs a frame of cells for each of particles; choose speed or plain")

    def chosen(self, frames: Sequence[int]) -> list[int]:
        """Return the numbers of the frames asked for, each once, in order; all if none is asked for. Negative ones count from the end.

        Raises:
            RenderError: there is no such frame.
        """
        found = set()
        for frame in frames:
            number = self.numbers[frame] if -len(self.numbers) <= frame < 0 else frame
            if number not in self.numbers:
                raise RenderError(f"--frame {frame}: there is no such frame; the run has {self.numbers[0]} to {self.numbers[-1]}")
            found.add(number)
        return sorted(found) or self.numbers

    def read(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the particles of a frame, those with finite numbers: positions [m], shape (n, 3), and what colors them, shape (n,).

        Raises:
            RenderError: a file cannot be read, or lacks the field that colors the particles.
        """
        mesh = _read(self._file("particles", number))
        if mesh is None:
            return np.zeros((0, 3)), np.zeros(0)
        points = np.asarray(mesh.points, dtype=np.float64)
        if self.color is Color.PRESSURE:
            values = self._pressure(number, points)
        elif self.color in LABELS:
            values = self._field(mesh.point_data, self.color)
        elif self.color is Color.SPEED:
            values = np.linalg.norm(self._field(mesh.point_data, "velocity"), axis=1)
        else:
            values = np.zeros(len(points))
        finite = np.isfinite(points).all(axis=1) & np.isfinite(values)
        return points[finite], values[finite]

    def scale(self) -> Scale:
        """Return the colors for the whole run: up to what 98 of 100 particles stay below, rounded up; the few above take the last color."""
        if self.color is Color.PLAIN:
            return Scale("", -1.0, 1.0, PALETTES[self.scene.palette])
        samples = [self.read(number)[1] for number in spread(self.numbers, SCALE_FRAMES)]
        low, high = np.percentile(np.concatenate([[0.0], *(values[:: len(values) // SCALE_VALUES + 1] for values in samples)]), [2.0, 98.0])
        high = _round_up(high)
        low = -_round_up(-low) if low < -0.01 * high else 0.0  # liquid that a wall holds has pressure below 0
        if self.color is Color.SPEED:
            return Scale("speed [m/s]", low, high, PALETTES[self.scene.palette])
        return Scale(LABELS.get(self.color, "pressure [Pa]"), low, high, VIRIDIS)

    def particle_spacing(self) -> float:
        """Return how far apart neighbors are at the start [m], from the number of particles in the cells that hold some."""
        points, _ = self.read(self.numbers[0])
        if not len(points):
            return self.scene.spacing
        cells = np.unique(np.floor(points / self.scene.spacing), axis=0)
        return float(self.scene.spacing * (len(cells) / len(points)) ** (1.0 / self.scene.dimension))

    def _numbers(self, name: str) -> list[int]:
        matches = [FRAME_FILE.fullmatch(file.name) for file in (self.folder / "frames").glob(f"{name}_*.vtu")]
        return sorted(int(match["index"]) for match in matches if match and match["name"] == name)

    def _file(self, name: str, number: int) -> Path:
        return self.folder / "frames" / f"{name}_{number:06d}.vtu"

    def _field(self, fields: dict[str, Any], name: str) -> np.ndarray:
        if name not in fields:
            raise RenderError(f"{self.folder}: the frames have no {name}, which --color {self.color} needs; plain needs nothing")
        return np.asarray(fields[name], dtype=np.float64)

    def _pressure(self, number: int, points: np.ndarray) -> np.ndarray:
        """Return the pressure of each particle's cell [Pa], 0 where the frame has no such cell."""
        mesh = _read(self._file("grid", number))
        counts = np.array(self.scene.cell_counts)
        table = np.zeros(counts)
        if mesh is not None:
            low_corners = mesh.points[mesh.cells[0].data[:, 0]] / self.scene.spacing
            table[tuple(np.rint(low_corners).astype(int).T)] = self._field(mesh.cell_data, "pressure")[0]
        cell = np.clip(np.floor(np.nan_to_num(points) / self.scene.spacing), 0, counts - 1).astype(int)
        return cast(np.ndarray, table[tuple(cell.T)])


def spread(numbers: Sequence[int], count: int) -> list[int]:
    """Return at most `count` of the numbers, evenly spaced, with the first and the last."""
    places = np.linspace(0, len(numbers) - 1, min(count, len(numbers)))
    return [numbers[round(place)] for place in places]


def _read(file: Path) -> meshio.Mesh | None:
    """Return a frame's mesh; None if it is empty, which meshio cannot read."""
    try:
        with open(file, "rb") as stream:
            if b'NumberOfPoints="0"' in stream.read(1000):
                return None
        return meshio.vtu.read(str(file))
    except OSError as error:
        raise RenderError(f"{file}: cannot be read: {error.strerror}") from error
    except (meshio.ReadError, ValueError, AttributeError, KeyError) as error:
        raise RenderError(f"{file}: is not a readable frame") from error


def _round_up(value: float) -> float:
    """Return the next round number; 1 for 0."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(ROUND_NUMBERS[np.searchsorted(ROUND_NUMBERS, value / power * (1.0 - 1e-9))] * power)
