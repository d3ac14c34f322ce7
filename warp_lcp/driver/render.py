"""Images of a run as PNG files, with the time and a legend, alone or side by side. Needs the extra `render`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_lcp.driver.atomic import replacing
from warp_lcp.driver.recording import Color, Recording, RenderError, spread
from warp_lcp.driver.stage import Stage

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

INSTALL = "pip install 'pyvista>=0.45'"
SMALLEST, LARGEST = 240, 4096  # pixels along a side of an image
SMALLEST_PICTURE = 32
SHEET_FRAMES = 6
INK = "#33373b"


def render_run(
    folder: Path,
    *,
    frames: Sequence[int] = (),
    size: tuple[int, int] = (1280, 720),
    out: Path | None = None,
    color: Color = Color.SPEED,
    sheet: bool = False,
) -> Iterator[Path]:
    """Draw frames of a run, in SI units on a color scale that fits the whole run; yield each file when it is written.

    Args:
        folder: of the run.
        frames: numbers of frames, negative ones counted from the end; all (for a sheet, some evenly spaced) unless given.
        size: width and height of an image [pixels].
        out: where the images go; `folder / "images"` unless given.
        color: what the color of a particle means.
        sheet: draw the frames side by side into one image, `sheet.png`.

    Raises:
        RenderError: pyvista is missing, there are no such frames, or an image cannot be written.
        SceneError: the run's scene cannot be read.
    """
    try:
        import pyvista
    except ImportError as error:
        raise RenderError(f"images need pyvista, which cannot be loaded ({error}): {INSTALL}") from error
    recording = Recording(folder, color)
    numbers = recording.chosen(frames)
    if sheet and not frames:
        numbers = spread(numbers, SHEET_FRAMES)
    groups = {"sheet.png": numbers} if sheet else {f"frame_{number:06d}.png": [number] for number in numbers}
    out = out or folder / "images"
    with pyvista.vtk_verbosity("off"):  # VTK warns where there is no display, and draws all the same
        page = Page(recording, size, pictures=len(numbers) if sheet else 1)
        with closing(page.stage):
            for name, group in groups.items():
                _save(page.draw(group), out / name)
                yield out / name


class Page:
    """The layout of an image: a line with time or name and the legend, below it one picture or several with a line each.

    Args:
        recording: what is drawn.
        size: width and height [pixels].
        pictures: how many.

    Raises:
        RenderError: the image is too small for them.
    """

    def __init__(self, recording: Recording, size: tuple[int, int], pictures: int) -> None:
        """Set the stage."""
        self.recording, self.size, self.scale = recording, size, recording.scale()
        self.line = max(20, round(0.065 * min(size)))  # heights [pixels]
        self.caption = round(0.8 * self.line) if pictures > 1 else 0
        sides = recording.scene.domain.size
        aspect = sides[0] / sides[1] if len(sides) == 2 else 1.5  # of a picture; a room is seen at an angle
        tiles = {columns: self._tile(columns, pictures) for columns in range(1, pictures + 1)}
        self.columns, (width, height) = max(tiles.items(), key=lambda item: min(item[1][0], aspect * item[1][1]))
        if min(width, height) < SMALLEST_PICTURE:
            raise RenderError(f"--size {size[0]}x{size[1]}: is too small for {pictures} pictures; enlarge it or choose fewer frames")
        if pictures > 1:  # a sheet is only as high as its pictures
            height = min(height, round(width / aspect))
            self.size = size[0], self.line + -(-pictures // self.columns) * (height + self.caption)
        self.tile = width, height
        self.stage = Stage(recording.scene, self.tile, recording.particle_spacing())

    def draw(self, numbers: Sequence[int]) -> Image:
        """Return the image of these frames."""
        from PIL import Image, ImageDraw

        page = Image.new("RGB", self.size, "white")
        pen = ImageDraw.Draw(page)
        width, height = self.tile
        clock = self.recording.scene.time
        digits = 2 if clock.frames_per_second <= 100 else 3
        for place, number in enumerate(numbers):
            points, values = self.recording.read(number)
            left, top = place % self.columns * width, self.line + place // self.columns * (height + self.caption)
            moment = clock.frame_time(number)
            page.paste(self.stage.draw(points, self.scale.colors(values), moment), (left, top + self.caption))
            time = f"t = {moment:.{digits}f} s"
            if self.caption:
                self._write(pen, time, left + width / 2, top + self.caption / 2, "mm")
            else:
                self._write(pen, time, 0.5 * self.line, 0.55 * self.line, "lm")
        if self.caption:
            self._write(pen, self.recording.scene.scene.name, 0.5 * self.line, 0.55 * self.line, "lm")
        self._draw_legend(page)
        return page

    def _tile(self, columns: int, pictures: int) -> tuple[int, int]:
        """Return the width and height of a picture when so many stand side by side."""
        return self.size[0] // columns, (self.size[1] - self.line) // -(-pictures // columns) - self.caption

    def _draw_legend(self, page: Image) -> None:
        """Draw `speed [m/s] 0 [colors] 3` at the right of the first line."""
        from PIL import Image, ImageDraw

        if not self.scale.label:
            return
        pen = ImageDraw.Draw(page)
        width, height, middle = round(0.16 * self.size[0]), round(0.3 * self.line), 0.55 * self.line
        right = self.size[0] - 0.5 * self.line
        right = self._write(pen, f"{self.scale.high:g}", right, middle, "rm") - 0.25 * self.line
        colors = self.scale.colors(np.linspace(self.scale.low, self.scale.high, width))
        bar = Image.fromarray(np.broadcast_to(colors.astype(np.uint8), (height, width, 3)).copy())
        page.paste(bar, (round(right) - width, round(middle - 0.5 * height)))
        right = self._write(pen, f"{self.scale.low:g}", right - width - 0.25 * self.line, middle, "rm")
        self._write(pen, self.scale.label, right - 0.5 * self.line, middle, "rm")

    def _write(self, pen: ImageDraw, text: str, x: float, y: float, anchor: str) -> float:
        """Write beside a point and return where the text begins."""
        from PIL import ImageFont

        font = ImageFont.load_default(0.5 * self.line)
        pen.text((x, y), text, fill=INK, font=font, anchor=anchor)
        return x - pen.textlength(text, font=font)


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height [pixels] of text such as `1280x720`.

    Raises:
        RenderError: it reads otherwise, or an image cannot be that small or large.
    """
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise RenderError(f"--size {text}: must be a width and a height of {SMALLEST} to {LARGEST} pixels, such as 1280x720")
    return width, height


def _save(image: Image, file: Path) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            image.save(temporary, format="PNG")
    except OSError as error:
        raise RenderError(f"{file}: cannot be written: {error.strerror}") from error
