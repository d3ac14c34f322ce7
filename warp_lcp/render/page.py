"""The layout of an image of a run: a line with the time and a legend, below it one picture or several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from warp_lcp.render.recording import Frame, Recording, RenderError

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

SMALLEST_PICTURE = 32  # pixels along a side
INK = "#33373b"


class Painter(Protocol):
    """What draws the pictures on a page."""

    def draw(self, frame: Frame) -> Image:
        """Return a picture of a frame."""

    def close(self) -> None:
        """Free what it holds."""


class Page:
    """The layout of an image: a line with time or name and the legend, below it one picture or several with a line each.

    Args:
        recording: what is drawn.
        size: width and height [pixels].
        pictures: how many.
        painter: makes what draws the pictures, given the recording and their width and height [pixels].

    Raises:
        RenderError: the image is too small for them.
    """

    def __init__(
        self, recording: Recording, size: tuple[int, int], pictures: int, painter: Callable[[Recording, tuple[int, int]], Painter]
    ) -> None:
        """Set the stage."""
        self.recording, self.size = recording, size
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
        self.scale = recording.scale
        self.painter = painter(recording, self.tile)

    def draw(self, numbers: Sequence[int]) -> Image:
        """Return the image of these frames."""
        from PIL import Image, ImageDraw

        page = Image.new("RGB", self.size, "white")
        pen = ImageDraw.Draw(page)
        width, height = self.tile
        clock = self.recording.scene.time
        digits = 2 if clock.frames_per_second <= 100 else 3
        for place, number in enumerate(numbers):
            left, top = place % self.columns * width, self.line + place // self.columns * (height + self.caption)
            moment = clock.frame_time(number)
            page.paste(self.painter.draw(self.recording.frame(number)), (left, top + self.caption))
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
