"""Images and films of a run, with time and legend, alone or side by side.

Needs the extra `render`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from warp_lcp.files.atomic import make_folder, replacing
from warp_lcp.render.film import Film, film_suffix
from warp_lcp.render.image_content import Color, RenderError, VisiblePart
from warp_lcp.render.page import Page, Painter
from warp_lcp.render.recording import Recording, spread

INSTALL = "pip install 'pyvista>=0.45'"
INSTALL_MATPLOTLIB = "pip install 'matplotlib>=3.9'"
SMALLEST, LARGEST = 240, 4096  # pixels along a side of an image
SHEET_FRAMES = 6
# Seconds of a core per image, megapixel and million points of particles and surface: 2-D, 3-D, a
# section. Measured for 3,000 to 650,000 particles at 640 x 360 and 1280 x 720; within a factor of
# 2.
FLAT_SECONDS, ROOM_SECONDS, SECTION_SECONDS = (0.03, 0.15, 2.0), (0.1, 0.65, 2.0), (0.08, 0.03, 2.0)
# Compression of PNGs, 1 to 9: a quarter of the time of PIL's default, 6, with files a third larger.
PACKING = 1


@dataclass(frozen=True, kw_only=True)
class ImageStyle:
    """Appearance of a run's images.

    Args:
        size: width and height of an image [pixels].
        color: quantity of the particles' colors. Default: speed.
        show: part of the material to show; see `Recording`.
        cut: draw a section with Matplotlib, which needs no pyvista.
        at: z of the section through a 3-D run [m]. Default: the middle.
        overrides: overrides of the scene's table [camera], such as `camera.position=[1, 2, 3]`.
    """

    size: tuple[int, int] = (1280, 720)
    color: Color | None = None
    show: VisiblePart | None = None
    cut: bool = False
    at: float | None = None
    overrides: Sequence[str] = ()


def render_run(
    folder: Path,
    *,
    frames: Sequence[int] = (),
    looks: ImageStyle | None = None,
    out: Path | None = None,
    sheet: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, of: None,
    estimated: Callable[[float], None] = lambda seconds: None,
) -> Iterator[Path]:
    """Draw frames of a run; yield each finished file.

    In SI units, on a color scale for the whole run.

    Args:
        folder: folder of the run.
        frames: numbers of frames, negative ones counted from the end. Default: all (for a sheet,
            some evenly spaced ones).
        looks: appearance of the images.
        out: folder of the images. Default: `folder / "images"`.
        sheet: draw the frames side by side into one image, `sheet.png`.
        on_progress: called with the number of finished images, and the total number.
        estimated: called with the estimated time of one core [s], before drawing begins, if there
            are several frames.

    Raises:
        RenderError: a package is missing, there are no such frames, or an image cannot be written.
        SceneError: the run's scene cannot be read.
    """
    looks = looks or ImageStyle()
    with ExitStack() as stack:
        painter = _painter(looks, stack)
        recording = Recording(folder, looks.color, looks.show, looks.overrides, cells=looks.cut)
        numbers = recording.chosen(frames)
        if sheet and not frames:
            numbers = spread(numbers, SHEET_FRAMES)
        name = "slice" if looks.cut else "frame"
        groups = (
            {"sheet.png": numbers}
            if sheet
            else {f"{name}_{number:06d}.png": [number] for number in numbers}
        )
        out = out or folder / "images"
        page = Page(recording, looks.size, len(numbers) if sheet else 1, painter)
        stack.enter_context(closing(page.painter))
        if len(numbers) > 1:
            estimated(expected_seconds(recording, numbers, looks))
        on_progress(0, len(groups))
        for done, (file, group) in enumerate(groups.items(), 1):
            _save(page.draw(group), out / file, folder)
            on_progress(done, len(groups))
            yield out / file


def film_run(
    folder: Path,
    film: Path,
    *,
    looks: ImageStyle | None = None,
    rate: float | None = None,
    on_progress: Callable[[int, int], None] = lambda done, of: None,
    estimated: Callable[[float], None] = lambda seconds: None,
) -> Iterator[int]:
    """Draw all frames of a run into a film; yield the number of each drawn frame.

    Args:
        folder: folder of the run.
        film: the file; `.mp4` or `.gif`.
        looks: appearance of the images.
        rate: frames per second of the film [1/s]. Default: that of the scene, for real time.
        on_progress: called with the number of finished images, and the total number.
        estimated: called with the estimated time of one core [s], before drawing begins, if there
            are several frames.

    Raises:
        RenderError: a package is missing, there are no frames, or the film cannot be written.
        SceneError: the run's scene cannot be read.
    """
    looks = looks or ImageStyle()
    film_suffix(film)
    with ExitStack() as stack:
        painter = _painter(looks, stack)
        recording = Recording(folder, looks.color, looks.show, looks.overrides, cells=looks.cut)
        page = Page(recording, looks.size, 1, painter)
        stack.enter_context(closing(page.painter))
        reel = stack.enter_context(
            Film(film, page.size, rate or recording.scene.time.frames_per_second)
        )
        if len(recording.numbers) > 1:
            estimated(expected_seconds(recording, recording.numbers, looks))
        on_progress(0, len(recording.numbers))
        for done, number in enumerate(recording.numbers, 1):
            reel.add(partial(page.draw, [number]))
            on_progress(done, len(recording.numbers))
            yield number


def expected_seconds(recording: Recording, numbers: Sequence[int], looks: ImageStyle) -> float:
    """Return the estimated time of drawing frames on one core [s].

    It is based on the content of the middle frame.

    Raises:
        RenderError: the frame cannot be read.
    """
    frame = recording.frame(numbers[len(numbers) // 2])
    points = len(frame.points) + (0 if frame.surface is None else len(frame.surface.points))
    each, pixels, held = (
        SECTION_SECONDS
        if looks.cut
        else FLAT_SECONDS
        if recording.scene.dimension == 2
        else ROOM_SECONDS
    )
    return len(numbers) * (each + 1e-6 * (pixels * math.prod(looks.size) + held * points))


def _painter(
    looks: ImageStyle, stack: ExitStack
) -> Callable[[Recording, tuple[int, int]], Painter]:
    """Return the constructor of the renderer of a page's pictures.

    Raises:
        RenderError: a package is missing, or an option is not supported.
    """
    if looks.cut:
        try:
            import matplotlib as _  # noqa: F401
        except ImportError as error:
            raise RenderError(
                f"--slice needs Matplotlib, which cannot be loaded ({error}): {INSTALL_MATPLOTLIB}"
            ) from error
        from warp_lcp.render.section import Section

        return partial(Section, at=looks.at)
    if looks.at is not None:
        raise RenderError("--at: needs --slice")
    try:
        import pyvista
    except ImportError as error:
        raise RenderError(
            f"images need pyvista, which cannot be loaded ({error}): {INSTALL}; --slice draws a "
            "section without it"
        ) from error
    from warp_lcp.render.picture import Picture

    # VTK warns without a display, but draws anyway.
    stack.enter_context(pyvista.vtk_verbosity("off"))
    return Picture


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height [pixels] of text such as `1280x720`.

    Raises:
        RenderError: the text has another format, or the size is out of range.
    """
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise RenderError(
            f"--size {text}: must be a width and a height of {SMALLEST} to {LARGEST} pixels, such "
            "as 1280x720"
        )
    return width, height


def _save(pixels: np.ndarray, file: Path, folder: Path) -> None:
    """Write an image, in a run's folder never through a link."""
    from PIL import Image

    try:
        make_folder(file.parent, within=folder)
        with replacing(file) as stream:
            Image.fromarray(pixels).save(stream, format="PNG", compress_level=PACKING)
    except OSError as error:
        raise RenderError(f"{file}: cannot be written: {error.strerror}") from error
