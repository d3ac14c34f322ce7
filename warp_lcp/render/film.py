"""Films, encoded by FFmpeg image by image.

FFmpeg comes with the package imageio-ffmpeg. One image at a time is in memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from warp_lcp.files.atomic import replacing_by_name
from warp_lcp.render.image_content import RenderError

INSTALL_ENCODER = "pip install 'imageio-ffmpeg>=0.6'"
SLOWEST, FASTEST = 0.1, 240.0  # frames per second of a film
GIF_FASTEST = 50.0  # frames per second: viewers slow down faster animations
QUALITY = "18"  # of x264, from 0 (lossless) to 51: flat colors and thin lines stay clean
# A palette for each image of a GIF.
OWN_COLORS = "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=none"
ENCODERS: dict[str, dict[str, str | int | list[str]]] = {  # H.264 in MP4; a GIF repeats forever
    ".mp4": {
        "codec": "libx264",
        "pix_fmt_out": "yuv420p",
        "output_params": ["-crf", QUALITY, "-movflags", "+faststart", "-f", "mp4"],
    },
    ".gif": {
        "codec": "gif",
        "pix_fmt_out": "pal8",
        "output_params": ["-filter_complex", OWN_COLORS, "-loop", "0", "-f", "gif"],
    },
}


class Film:
    """Film under construction; its file is created when the `with` block ends.

    No file is created if the block raises an error.

    Args:
        file: file of the film, `.mp4` or `.gif`; a GIF omits images whose rate is above the limit
            of viewers.
        size: width and height of its images [pixels].
        rate: frames per second [1/s].

    Raises:
        RenderError: the encoder is missing, or the file cannot be written.
    """

    def __init__(self, file: Path, size: tuple[int, int], rate: float) -> None:
        self.file, self.size, self.suffix = file, size, film_suffix(file)
        self._every = (
            max(1, math.ceil(rate / GIF_FASTEST * (1.0 - 1e-9))) if self.suffix == ".gif" else 1
        )
        self._rate, self._offered = rate / self._every, 0

    def add(self, draw: Callable[[], np.ndarray]) -> None:
        """Add an image, red, green and blue from 0 to 255.

        An image that exceeds the rate of a GIF is not drawn.

        Raises:
            RenderError: the file cannot be written.
        """
        self._offered += 1
        if (self._offered - 1) % self._every:
            return
        pixels = np.asarray(draw())
        padding = [
            (0, self._even[1] - pixels.shape[0]),
            (0, self._even[0] - pixels.shape[1]),
            (0, 0),
        ]
        try:
            self._writer.send(np.ascontiguousarray(np.pad(pixels, padding, mode="edge")))
        except OSError as error:
            raise self._failure(error) from error

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                self._writer = self._encoder(stack.enter_context(replacing_by_name(self.file)))
            except OSError as error:
                raise self._failure(error) from error
            stack.callback(self._writer.close)
            try:
                self._writer.send(None)
            except RuntimeError as error:
                raise RenderError(f"a film needs FFmpeg: {str(error).splitlines()[0]}") from error
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write the film to disk; delete it after an error."""
        try:
            self._stack.__exit__(kind, error, trace)
        except OSError as failure:
            raise self._failure(failure) from failure

    def _encoder(self, temporary: Path) -> Generator[None, np.ndarray | None, None]:
        """Return the encoder, which receives the images."""
        try:
            import imageio_ffmpeg
        except ImportError as error:
            raise RenderError(
                f"a film needs imageio-ffmpeg, which cannot be loaded ({error}): {INSTALL_ENCODER}"
            ) from error
        width, height = self.size
        whole = 2 if self.suffix == ".mp4" else 1  # its chroma has half the resolution
        self._even = width + -width % whole, height + -height % whole
        return imageio_ffmpeg.write_frames(
            str(temporary),
            self._even,
            fps=self._rate,
            macro_block_size=1,
            quality=None,
            ffmpeg_log_level="error",
            **ENCODERS[self.suffix],
        )

    def _failure(self, error: OSError) -> RenderError:
        return RenderError(
            f"{self.file}: cannot be written: "
            f"{error.strerror or str(error).strip().splitlines()[-1]}"
        )


def film_suffix(file: Path) -> str:
    """Return the suffix of a film, which selects the encoder.

    Raises:
        RenderError: there is no encoder for such films.
    """
    suffix = file.suffix.lower()
    if suffix not in ENCODERS:
        raise RenderError(f"--film {file}: must end in {' or '.join(ENCODERS)}")
    if file.is_dir():
        raise RenderError(f"--film {file}: is a folder; name a file")
    return suffix


def check_rate(rate: float | None) -> float | None:
    """Return a valid number of frames per second.

    Raises:
        RenderError: the rate is out of range.
    """
    if rate is not None and not SLOWEST <= rate <= FASTEST:
        raise RenderError(f"--fps {rate:g}: must be {SLOWEST:g} to {FASTEST:g} frames a second")
    return rate
