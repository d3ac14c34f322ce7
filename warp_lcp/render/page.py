"""Layout of an image: a line with time and legend, and one or more pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from warp_lcp.render.image_content import RenderError
from warp_lcp.render.recording import RecordedFrame, Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SMALLEST_PICTURE = 32  # pixels along a side
INK = "#33373b"
DOTS_AN_INCH, POINTS_AN_INCH = 100, 72


class Painter(Protocol):
    """Renderer of the pictures on a page."""

    def draw(self, frame: RecordedFrame) -> np.ndarray:
        """Return a picture of a frame."""

    def close(self) -> None:
        """Free windows and other resources; no drawing afterward."""


class Page:
    """Layout of an image: a line with time and legend, below it the pictures.

    Several pictures have a line each.

    Args:
        recording: the frames of the run.
        size: width and height [pixels].
        pictures: number of pictures.
        painter: creates the renderer of the pictures, from the recording and their width and height
            [pixels].

    Raises:
        RenderError: the image is too small for them.
    """

    def __init__(
        self,
        recording: Recording,
        size: tuple[int, int],
        pictures: int,
        painter: Callable[[Recording, tuple[int, int]], Painter],
    ) -> None:
        self.recording, self.size = recording, size
        self.line = max(20, round(0.065 * min(size)))  # heights [pixels]
        self.caption = round(0.8 * self.line) if pictures > 1 else 0
        sides = recording.scene.domain.size
        # Aspect of a picture; 3-D domains are seen at an angle.
        aspect = sides[0] / sides[1] if len(sides) == 2 else 1.5
        tiles = {columns: self._tile(columns, pictures) for columns in range(1, pictures + 1)}
        self.columns, (width, height) = max(
            tiles.items(), key=lambda item: min(item[1][0], aspect * item[1][1])
        )
        if min(width, height) < SMALLEST_PICTURE:
            raise RenderError(
                f"--size {size[0]}x{size[1]}: is too small for {pictures} pictures; enlarge it or "
                "choose fewer frames"
            )
        if pictures > 1:  # a sheet is only as high as its pictures
            height = min(height, round(width / aspect))
            self.size = size[0], self.line + -(-pictures // self.columns) * (height + self.caption)
        self.tile = width, height
        self.painter = painter(recording, self.tile)

    def draw(self, numbers: Sequence[int]) -> np.ndarray:
        """Return the image of these frames."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(
            figsize=(self.size[0] / DOTS_AN_INCH, self.size[1] / DOTS_AN_INCH), dpi=DOTS_AN_INCH
        )
        canvas = FigureCanvasAgg(figure)
        width, height = self.tile
        clock = self.recording.scene.time
        digits = 2 if clock.frames_per_second <= 100 else 3
        corners = [
            (
                place % self.columns * width,
                self.line + place // self.columns * (height + self.caption),
            )
            for place in range(len(numbers))
        ]
        for number, (left, top) in zip(numbers, corners, strict=True):
            time = f"t = {clock.frame_time(number):.{digits}f} s"
            if self.caption:
                self._write(figure, time, left + width / 2, top + self.caption / 2, "center")
            else:
                self._write(figure, time, 0.5 * self.line, 0.55 * self.line, "left")
        if self.caption:
            self._write(
                figure, self.recording.scene.scene.name, 0.5 * self.line, 0.55 * self.line, "left"
            )
        self._draw_legend(figure)
        canvas.draw()
        image = np.array(canvas.buffer_rgba())[..., :3]
        # Copied here, since Matplotlib would take as long as drawing them.
        for number, (left, top) in zip(numbers, corners, strict=True):
            picture = image[top + self.caption : top + self.caption + height, left : left + width]
            picture[:] = self.painter.draw(self.recording.frame(number))
        return image

    def _tile(self, columns: int, pictures: int) -> tuple[int, int]:
        """Return the width and height of a picture in a given number of columns."""
        return self.size[0] // columns, (self.size[1] - self.line) // -(
            -pictures // columns
        ) - self.caption

    def _draw_legend(self, figure: Figure) -> None:
        """Draw `speed [m/s]  0 [colors] 3` at the right of the first line."""
        scale = self.recording.scale
        if not scale.label:
            return
        width, height, middle = 0.16 * self.size[0], 0.3 * self.line, 0.55 * self.line
        left, gap = self.size[0] - width - 2.0 * self.line, 0.25 * self.line
        place = (
            left / self.size[0],
            1.0 - (middle + height / 2) / self.size[1],
            width / self.size[0],
            height / self.size[1],
        )
        bar = figure.colorbar(
            scale.mappable, cax=figure.add_axes(place), orientation="horizontal", ticks=[]
        )
        bar.outline.set_visible(False)
        self._write(figure, f"{scale.label}  {scale.low:g}", left - gap, middle, "right")
        self._write(figure, f"{scale.high:g}", left + width + gap, middle, "left")

    def _write(self, figure: Figure, text: str, x: float, y: float, anchor: str) -> None:
        """Write a text at a point, x and y from the upper left corner [pixels]."""
        size = 0.45 * self.line * POINTS_AN_INCH / DOTS_AN_INCH
        figure.text(
            x / self.size[0],
            1.0 - y / self.size[1],
            text,
            fontsize=size,
            color=INK,
            ha=anchor,
            va="center",
        )
