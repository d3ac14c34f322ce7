"""Frames of a run, read back for images, and their common color scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

from warp_lcp.frames.frame_folder import FRAME_FILE
from warp_lcp.frames.meshio_format import WRITTEN_ONLY
from warp_lcp.frames.read_frame import READABLE, read_part
from warp_lcp.frames.vtu import VtuMesh
from warp_lcp.render.image_content import (
    LABELS,
    PARTS,
    WITH_PARTICLES,
    WITH_SURFACE,
    Color,
    RenderError,
    VisiblePart,
)
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import check_shapes, load_scene
from warp_lcp.simulation import Cells, Points, Surface

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable

SCALE_FRAMES = 16  # evenly spaced frames that define the color scale of a run
SCALE_VALUES = 50_000  # approximate number of values of each
ROUND_NUMBERS = np.array([1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0])
PALETTES = {  # for speeds, by `Scene.palette`
    "water": ("#0e3e8a", "#166abe", "#3aa0e0", "#82d0f0", "#cef0fa"),
    "sand": ("#a8743e", "#bd8a50", "#d2a468", "#e4be82", "#f2d8a4"),
}


@dataclass(frozen=True)
class RecordedFrame:
    """Data of an image of a frame.

    Args:
        time: [s].
        points: positions of the particles [m], shape (n, 3).
        values: values for their colors, shape (n,).
        surface: surface of the material; None if not shown.
        bodies: current surfaces of rigid bodies, with the field `body`; None if the scene has none.
        cells: cells with their fields; None if not shown.
        ids: ids of the particles, int64, shape (n,); None if the frame has none.
        whitewater: spray, foam and bubbles with the field `kind`; None if the run has none.
    """

    time: float
    points: np.ndarray
    values: np.ndarray
    surface: Surface | None = None
    bodies: Surface | None = None
    cells: Cells | None = None
    ids: np.ndarray | None = None
    whitewater: Points | None = None


ContentT = TypeVar("ContentT", VtuMesh, Cells)


@dataclass(frozen=True)
class ColorScale:
    """Color scale from `low` to `high`, the same in every image of a run.

    A scale without a label has no legend.

    Args:
        label: quantity and unit.
        low: the value of the first color.
        high: the value of the last color.
        palette: evenly spaced colors. Default: Matplotlib's viridis.
    """

    label: str
    low: float
    high: float
    palette: tuple[str, ...] = ()

    @cached_property
    def mappable(self) -> ScalarMappable:
        """The scale as a Matplotlib mappable."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        colors = (
            LinearSegmentedColormap.from_list("palette", self.palette)
            if self.palette
            else "viridis"
        )
        return ScalarMappable(Normalize(self.low, self.high), colors)

    def colors(self, values: np.ndarray) -> np.ndarray:
        """Return a color for each value, 0 to 255, shape (n, 3)."""
        return self.mappable.to_rgba(values, bytes=True)[:, :3]


class Recording:
    """Frames of a run, for reading.

    Args:
        folder: folder of the run.
        color: quantity to read besides the positions. Default: speed.
        show: part of the material to read. Default: particles if a color is set, for sand, or if
            there is no surface; else the surface; bodies if the run writes nothing else.
        overrides: overrides of the scene's table [camera], such as `camera.position=[1, 2, 3]`.
        cells: read the cells too, if the run wrote them; then their pressure is the color unless
            another is set, or only the surface is shown.

    Raises:
        RenderError: the folder is not that of a run, or has no such frames.
        SceneError: its scene cannot be read.
    """

    def __init__(
        self,
        folder: Path,
        color: Color | None = None,
        show: VisiblePart | None = None,
        overrides: Sequence[str] = (),
        *,
        cells: bool = False,
    ) -> None:
        """Find the frames in the folder."""
        if not (folder / "scene.toml").is_file():
            why = "it has no scene.toml" if folder.is_dir() else "there is no such folder"
            raise RenderError(f"{folder}: is not the folder of a run: {why}")
        for override in overrides:
            if not override.startswith("camera."):
                raise RenderError(
                    f"--set {override}: only keys of [camera] can be set for images of a run"
                )
        self.folder = folder
        self.scene: Scene = load_scene(folder / "scene.toml", overrides)
        check_shapes(self.scene, str(folder / "scene.toml"))
        self.cells = cells
        output = self.scene.output
        surface_alone = bool(self._numbers("surface")) and not self._numbers("particles")
        if (
            cells
            and color is None
            and show in (None, *WITH_PARTICLES)
            and not surface_alone
            and self._numbers("particles")
        ):
            color = Color.PRESSURE if self._numbers("grid") else Color.SPEED
        # The surface of a heap has holes where it is thin, and looks like clay elsewhere.
        grains = self.scene.palette == "sand" and bool(self._numbers("particles"))
        smooth = color is None and not grains and bool(self._numbers("surface"))
        bodies_alone = (
            color in (None, Color.PLAIN)
            and not (output.particles or output.surface)
            and bool(self._numbers("bodies"))
        )
        self.show = show or (
            VisiblePart.BODIES
            if bodies_alone
            else VisiblePart.SURFACE
            if smooth
            else VisiblePart.PARTICLES
        )
        if self.show not in WITH_PARTICLES and color not in (None, Color.PLAIN):
            raise RenderError(
                f"--color {color} is for particles, which --show {self.show} leaves out; choose "
                "both or particles"
            )
        self.color = Color.PLAIN if self.show not in WITH_PARTICLES else color or Color.SPEED
        self.find_new_frames()
        if self.color is Color.PRESSURE and not set(self.numbers) <= set(self._numbers("grid")):
            raise RenderError(
                f"{folder}: --color pressure needs a frame of cells for each frame of particles; "
                "choose speed or plain"
            )

    def chosen(self, frames: Sequence[int]) -> list[int]:
        """Return the numbers of requested frames, each once, in order.

        All if none is requested. Negative ones count from the end.

        Raises:
            RenderError: there is no such frame.
        """
        selected = set()
        for frame in frames:
            number = self.numbers[frame] if -len(self.numbers) <= frame < 0 else frame
            if number not in self.numbers:
                raise RenderError(
                    f"--frame {frame}: there is no such frame; the run has {self.numbers[0]} to "
                    f"{self.numbers[-1]}"
                )
            selected.add(number)
        return sorted(selected) or self.numbers

    def frame(self, number: int) -> RecordedFrame:
        """Return the data of an image of a frame.

        Raises:
            RenderError: a file cannot be read, or lacks a field.
        """
        points, values, ids = (
            (np.zeros((0, 3)), np.zeros(0), None)
            if self.show not in WITH_PARTICLES
            else self._read(number)
        )
        surface = self.surface(number) if self.show in WITH_SURFACE else None
        filled = (
            self._cells(number) if self.cells and self._file("grid", number).is_file() else None
        )
        return RecordedFrame(
            self.scene.time.frame_time(number),
            points,
            values,
            surface,
            self.bodies(number),
            filled,
            ids,
            self.whitewater(number),
        )

    def surface(self, number: int) -> Surface:
        """Return the surface of the material in a frame.

        Raises:
            RenderError: the file cannot be read.
        """
        return self._surface("surface", number)

    def particles(self, number: int) -> Points:
        """Return the particles of a frame with finite positions, and their fields.

        Raises:
            RenderError: the file cannot be read.
        """
        return self._points("particles", number)

    def whitewater(self, number: int) -> Points | None:
        """Return spray, foam and bubbles of a frame, with the field `kind`.

        Returns None if the run has none, or if only bodies are shown.

        Raises:
            RenderError: the file cannot be read, or has no kinds.
        """
        file = self._file("whitewater", number)
        if self.show is VisiblePart.BODIES or not file.is_file():
            return None
        points = self._points("whitewater", number)
        kinds = points.fields.get("kind")
        if kinds is None or kinds.shape != (len(points.points),):
            raise RenderError(f"{file}: is not a readable frame: it has no kind of each particle")
        return points

    def _points(self, name: str, number: int) -> Points:
        """Return the points of a part with finite positions, and their fields."""
        mesh = _read(self._file(name, number), VtuMesh)
        finite = np.isfinite(mesh.points).all(axis=1)
        fields = {field: values[finite] for field, values in mesh.fields.items()}
        return Points(name, mesh.points[finite], fields)

    def bodies(self, number: int) -> Surface | None:
        """Return the surfaces of the rigid bodies in a frame; None if the run has none.

        Raises:
            RenderError: the file cannot be read.
        """
        return self._surface("bodies", number) if self._file("bodies", number).is_file() else None

    def read(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [m], shape (n, 3), and color values, shape (n,), of a frame.

        Only particles with finite numbers.

        Raises:
            RenderError: a file cannot be read, or lacks the field that colors the particles.
        """
        points, values, _ = self._read(number)
        return points, values

    @np.errstate(invalid="ignore")  # values that are no numbers are omitted
    def _read(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return positions and color values as of `read`, and ids if the frame has them."""
        particles = self.particles(number)
        points = np.asarray(particles.points, dtype=np.float64)
        if self.color is Color.PRESSURE:
            values = self._pressure(number, points)
        elif self.color in LABELS:
            values = self._field(particles.fields, self.color)
        elif self.color is Color.SPEED:
            values = np.linalg.norm(self._field(particles.fields, "velocity", 3), axis=1)
        else:
            values = np.zeros(len(points))
        finite, ids = np.isfinite(values), ids_of(particles)
        return points[finite], values[finite], None if ids is None else ids[finite]

    @cached_property
    def scale(self) -> ColorScale:
        """Return the color scale of the whole run.

        It ends at the 98th percentile of the particles, rounded up; larger values have the last
        color.
        """
        if self.color is Color.PLAIN or not self._numbers("particles"):
            return ColorScale("", -1.0, 1.0, PALETTES[self.scene.palette])
        samples = [self.read(number)[1] for number in spread(self.numbers, SCALE_FRAMES)]
        low, high = np.percentile(
            np.concatenate(
                [[0.0], *(values[:: len(values) // SCALE_VALUES + 1] for values in samples)]
            ),
            [2.0, 98.0],
        )
        high = _round_up(high)
        # Liquid that a wall holds has negative pressure.
        low = -_round_up(-low) if low < -0.01 * high else 0.0
        if self.color is Color.SPEED:
            return ColorScale("speed [m/s]", low, high, PALETTES[self.scene.palette])
        return ColorScale(LABELS.get(self.color, "pressure [Pa]"), low, high)

    def particle_spacing(self) -> float:
        """Return the initial distance of neighboring particles [m].

        It follows from the number of particles in the cells with particles.
        """
        points = (
            self.particles(self.numbers[0]).points
            if self.show in WITH_PARTICLES
            else np.zeros((0, 3))
        )
        if not len(points):
            return self.scene.spacing
        cells = np.unique(np.floor(points / self.scene.spacing), axis=0)
        return float(
            self.scene.spacing * (len(cells) / len(points)) ** (1.0 / self.scene.dimension)
        )

    def _numbers(self, name: str) -> list[int]:
        matches = [
            FRAME_FILE.fullmatch(file.name) for file in (self.folder / "frames").glob(f"{name}_*")
        ]
        return sorted(
            {
                int(match["index"])
                for match in matches
                if match and match["name"] == name and match["format"] in self._readable
            }
        )

    @cached_property
    def _readable(self) -> list[str]:
        """Return the suffixes of a part's file.

        A PLY file of a surface, beside one of another format, is not the run's frame.
        """
        return [
            suffix for suffix in READABLE if suffix != "ply" or self.scene.output.format == "ply"
        ]

    def find_new_frames(self) -> list[int]:
        """Search for new frames; return the numbers of the complete ones.

        Complete frames have all parts that are shown.

        Raises:
            RenderError: there is none.
        """
        parts = ("surface", "particles") if self.show is VisiblePart.BOTH else (PARTS[self.show],)
        part_numbers = {part: self._numbers(part) for part in parts}
        for part, numbers in part_numbers.items():
            if not numbers:
                output = self.scene.output
                why = "" if getattr(output, part, True) else f"; the scene's output.{part} is false"
                if output.format in WRITTEN_ONLY:
                    why = (
                        f'; output.format = "{output.format}" is for other programs and not read '
                        "back"
                    )
                raise RenderError(
                    f"{self.folder}: holds no frames of "
                    f"{'a surface' if part == 'surface' else part}{why}"
                )
        numbers = sorted(set.intersection(*map(set, part_numbers.values())))
        if not numbers:
            raise RenderError(f"{self.folder}: holds no frame of both {' and '.join(parts)}")
        self.numbers = numbers
        return numbers

    @np.errstate(invalid="ignore")  # values that are no numbers are omitted
    def _surface(self, name: str, number: int) -> Surface:
        """Return the triangles or segments of a surface with finite points."""
        file = self._file(name, number)
        mesh = _read(file, VtuMesh)
        corners = (
            mesh.corners
            if len(mesh.corners)
            else np.zeros((0, self.scene.dimension), dtype=np.int32)
        )
        if corners.shape[1] != self.scene.dimension:
            raise RenderError(
                f"{file}: has no {'triangles' if self.scene.dimension == 3 else 'segments'}"
            )
        points = np.asarray(mesh.points, dtype=np.float64)
        finite = np.isfinite(points[corners]).all(axis=(1, 2))
        return Surface(
            name,
            np.where(np.isfinite(points), points, 0.0),
            np.asarray(corners[finite], dtype=np.int32),
            mesh.fields,
        )

    def _cells(self, number: int) -> Cells | None:
        """Return the cells of a frame with their fields."""
        file = self._file("grid", number)
        if file.suffix in (".vti", ".pvti"):
            cells = _read(file, Cells)
        elif not len((mesh := _read(file, VtuMesh)).corners):
            return None
        else:
            low = np.nan_to_num(
                mesh.points[mesh.corners].mean(axis=1) / self.scene.spacing, nan=-1.0
            )
            index = np.floor(np.clip(low, -1.0, max(self.scene.cell_counts))).astype(int)
            cells = Cells("grid", index, self.scene.spacing, self.scene.dimension, mesh.fields)
        if not ((cells.index >= 0) & (cells.index < self.scene.cell_counts)).all():
            raise RenderError(
                f"{file}: is not a readable frame: a cell lies outside the scene's domain"
            )
        return cells

    def files(self, number: int) -> list[Path]:
        """Return the files of a frame's particles or surface, whitewater and bodies."""
        parts = {
            VisiblePart.PARTICLES: ["particles"],
            VisiblePart.SURFACE: ["surface"],
            VisiblePart.BOTH: ["particles", "surface"],
            VisiblePart.BODIES: [],
        }
        beside = ["bodies"] if self.show is VisiblePart.BODIES else ["bodies", "whitewater"]
        files = [self._file(part, number) for part in [*parts[self.show], *beside]]
        # Files of ranks.
        pieces = [
            piece for file in files for piece in sorted(file.parent.glob(f"rank_*/{file.stem}.*"))
        ]
        return [file for file in files if file.is_file()] + pieces

    def _file(self, name: str, number: int) -> Path:
        path = self.folder / "frames" / f"{name}_{number:06d}"
        files = [path.with_suffix(f".{suffix}") for suffix in self._readable]
        return next((file for file in files if file.is_file()), path.with_suffix(".vtu"))

    def _field(self, fields: dict[str, np.ndarray], name: str, components: int = 1) -> np.ndarray:
        if name not in fields or fields[name].shape[1:] != (components,)[: components - 1]:
            raise RenderError(
                f"{self.folder}: the frames have no {name}, which --color {self.color} needs; "
                "choose plain"
            )
        return np.asarray(fields[name], dtype=np.float64)

    def _pressure(self, number: int, points: np.ndarray) -> np.ndarray:
        """Return the pressure of each particle's cell [Pa]; 0 without such a cell."""
        cells = self._cells(number)
        counts = np.array(self.scene.cell_counts)
        table = np.zeros(counts)
        if cells is not None:
            table[tuple(cells.index.T)] = self._field(cells.fields, "pressure")
        cell = np.clip(np.floor(np.nan_to_num(points) / self.scene.spacing), 0, counts - 1).astype(
            int
        )
        return cast(np.ndarray, table[tuple(cell.T)])


def ids_of(particles: Points) -> np.ndarray | None:
    """Return the ids of a frame's particles, int64, shape (n,); None if it has none."""
    ids = particles.fields.get("id")
    return None if ids is None else np.asarray(ids).ravel().astype(np.int64)


def spread(numbers: Sequence[int], count: int) -> list[int]:
    """Return at most `count` of the numbers, evenly spaced.

    The first and the last are included.
    """
    places = np.linspace(0, len(numbers) - 1, min(count, len(numbers)))
    return [numbers[round(place)] for place in places]


def _read(file: Path, kind: type[ContentT]) -> ContentT:
    """Return the content of a frame's file, or of the parts in its list.

    Args:
        file: the file.
        kind: Mesh or Cells.

    Raises:
        RenderError: a file cannot be read, or has another kind of content.
    """
    try:
        found = read_part(file)
        if not isinstance(found, kind):
            raise ValueError(f"it holds a {type(found).__name__}, expected {kind.__name__}")
        return found
    except OSError as error:
        raise RenderError(f"{error.filename or file}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        known = "is not a readable frame" in str(error)
        raise RenderError(
            str(error) if known else f"{file}: is not a readable frame: {error}"
        ) from error


def _round_up(value: float) -> float:
    """Return the next round number; 1 for 0."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(
        ROUND_NUMBERS[np.searchsorted(ROUND_NUMBERS, value / power * (1.0 - 1e-9))] * power
    )
