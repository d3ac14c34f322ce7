"""Films: images that go into an MP4 or a GIF file one after the other, so that one at a time is in memory."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self

import numpy as np

from warp_lcp.frames.atomic import replacing
from warp_lcp.render.recording import RenderError

if TYPE_CHECKING:
    from PIL.Image import Image

INSTALL_ENCODER = "pip install 'imageio-ffmpeg>=0.6'"
SLOWEST, FASTEST = 0.1, 240.0  # frames a second of a film
GIF_FASTEST = 50.0  # frames a second: viewers slow down what changes every hundredth of a second
END = b";"  # of a GIF
QUALITY = "18"  # of x264, from 0 (no loss) to 51: flat colors and thin lines stay clean


class Film(ABC):
    """A film in the making; its file appears when the `with` block ends without an error.

    Args:
        file: of the film.
        size: width and height of its images [pixels].
        rate: frames a second [1/s].

    Raises:
        RenderError: the encoder is missing, or the file cannot be written.
    """

    def __init__(self, file: Path, size: tuple[int, int], rate: float) -> None:
        """Begin without images."""
        self.file, self.size, self.rate = file, size, rate

    @abstractmethod
    def add(self, draw: Callable[[], Image]) -> None:
        """Add an image; one that the film's kind has no time for is not even drawn.

        Raises:
            RenderError: the file cannot be written.
        """

    @abstractmethod
    def _open(self, temporary: Path, stack: ExitStack) -> None:
        """Begin to write into a file of another name; what ends that goes onto the stack."""

    def __enter__(self) -> Self:
        """Return the film itself."""
        with ExitStack() as stack:
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                self._open(stack.enter_context(replacing(self.file)), stack)
            except OSError as error:
                raise self._failure(error) from error
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Bring the film to disk, or leave nothing of it."""
        try:
            self._stack.__exit__(kind, error, trace)
        except OSError as failure:
            raise self._failure(failure) from failure

    def _failure(self, error: OSError) -> RenderError:
        return RenderError(f"{self.file}: cannot be written: {error.strerror or str(error).strip().splitlines()[-1]}")


class Mp4(Film):
    """H.264 in an MP4 file, encoded by FFmpeg, which the package imageio-ffmpeg brings."""

    def _open(self, temporary: Path, stack: ExitStack) -> None:
        try:
            import imageio_ffmpeg
        except ImportError as error:
            raise RenderError(
                f"an MP4 film needs imageio-ffmpeg, which cannot be loaded ({error}): {INSTALL_ENCODER}; or name a .gif"
            ) from error
        width, height = self.size
        self._even = width + width % 2, height + height % 2  # its chroma has half the resolution
        self._writer: Generator[None, Any, None] = imageio_ffmpeg.write_frames(
            str(temporary), self._even, fps=self.rate, codec="libx264", macro_block_size=1, quality=None, pix_fmt_out="yuv420p",
            output_params=["-crf", QUALITY, "-movflags", "+faststart", "-f", "mp4"], ffmpeg_log_level="error",
        )  # fmt: skip
        stack.callback(self._writer.close)
        try:
            self._writer.send(None)
        except RuntimeError as error:
            raise RenderError(f"an MP4 film needs FFmpeg: {str(error).splitlines()[0]}") from error

    def add(self, draw: Callable[[], Image]) -> None:
        """Add an image."""
        pixels = np.asarray(draw().convert("RGB"))
        padding = [(0, self._even[1] - pixels.shape[0]), (0, self._even[0] - pixels.shape[1]), (0, 0)]
        try:
            self._writer.send(np.ascontiguousarray(np.pad(pixels, padding, mode="edge")))
        except OSError as error:
            raise self._failure(error) from error


class Gif(Film):
    """A GIF that repeats for ever; each image has colors of its own. Rates above what viewers play leave images out."""

    def _open(self, temporary: Path, stack: ExitStack) -> None:
        self._stream: IO[bytes] = stack.enter_context(temporary.open("wb"))
        stack.callback(lambda: self._stream.write(END))
        self._every = max(1, math.ceil(self.rate / GIF_FASTEST * (1.0 - 1e-9)))
        self._offered = self._written = 0
        self._last: Image | None = None

    def add(self, draw: Callable[[], Image]) -> None:
        """Add an image, or leave it out."""
        import PIL.Image
        from PIL import GifImagePlugin, ImageChops

        self._offered += 1
        if (self._offered - 1) % self._every:
            return
        image = draw().convert("RGB")
        box = (0, 0, *image.size)
        if self._last is not None:
            box = ImageChops.difference(image, self._last).getbbox() or (0, 0, 1, 1)  # the rest of the image stays
        part = image.crop(box).quantize(256, method=PIL.Image.Quantize.MEDIANCUT, dither=PIL.Image.Dither.NONE)
        begin, end = (round(100.0 * self._every * count / self.rate) for count in (self._written, self._written + 1))
        try:
            if self._last is None:
                self._stream.writelines(GifImagePlugin.getheader(part, info={"loop": 0})[0])
            self._stream.writelines(GifImagePlugin.getdata(part, box[:2], duration=10 * (end - begin), include_color_table=True))
        except OSError as error:
            raise self._failure(error) from error
        self._last = image
        self._written += 1


KINDS: dict[str, type[Film]] = {".mp4": Mp4, ".gif": Gif}


def film_kind(file: Path) -> type[Film]:
    """Return what writes a film of this suffix.

    Raises:
        RenderError: nothing does.
    """
    if file.suffix.lower() not in KINDS:
        raise RenderError(f"--film {file}: must end in {' or '.join(KINDS)}")
    if file.is_dir():
        raise RenderError(f"--film {file}: is a folder; name a file")
    return KINDS[file.suffix.lower()]


def check_rate(rate: float | None) -> float | None:
    """Return frames a second as they were given.

    Raises:
        RenderError: no film can have so many or so few.
    """
    if rate is not None and not SLOWEST <= rate <= FASTEST:
        raise RenderError(f"--fps {rate:g}: must be {SLOWEST:g} to {FASTEST:g} frames a second")
    return rate
