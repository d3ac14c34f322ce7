"""Path-traced pictures and films of a run, one file per frame.

Pictures that exist with the same settings are kept.
"""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from warp_lcp.files import Tables
from warp_lcp.files.atomic import make_folder, replacing
from warp_lcp.render.film import Film, film_suffix
from warp_lcp.render.image_content import RenderError, VisiblePart
from warp_lcp.render.photo.mitsuba_renderer import (
    VERSION,
    Quality,
    choose_variant,
    load_renderer,
    render_radiance,
)
from warp_lcp.render.photo.photo_scene import PhotoScenes
from warp_lcp.render.photo.view_transform import agx
from warp_lcp.render.recording import Recording

EXPOSURE = 1.55  # factor on radiance, before AgX
CONTRAST, SATURATION = 1.6, 1.35  # applied after AgX's sigmoid
# CPU seconds of a million paths through liquid, and through grains, bodies and sky; and of a
# frame's geometry. Measured on an Intel Xeon; within a factor of 2.
LIQUID_SECONDS, OPAQUE_SECONDS = (
    {"scalar_rgb": 9.0, "llvm_ad_rgb": 4.6},
    {"scalar_rgb": 9.0, "llvm_ad_rgb": 4.2},
)
GEOMETRY_SECONDS = 8.0
SETTINGS_KEY = "warp-lcp photo"  # key of a PNG's text chunk
SAMPLES, MOST_SAMPLES = 64, 65536  # paths per pixel
SHUTTER = 0.25  # exposure in frame intervals


@dataclass(frozen=True, kw_only=True)
class PhotoSettings:
    """Settings of the pictures.

    Args:
        size: width and height [pixels].
        samples: paths per pixel.
        shutter: duration of the exposure, in frame intervals; 0 for no motion blur.
        show: part of the material to show; see `Recording`.
        overrides: overrides of the scene's table [camera], such as `camera.position=[1, 2, 3]`.

    Raises:
        RenderError: a value is out of range.
    """

    size: tuple[int, int] = (1280, 720)
    samples: int = SAMPLES
    shutter: float = SHUTTER
    show: VisiblePart | None = None
    overrides: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not 1 <= self.samples <= MOST_SAMPLES:
            raise RenderError(f"--samples {self.samples}: must be 1 to {MOST_SAMPLES}")
        if not 0.0 <= self.shutter <= 1.0:
            raise RenderError(f"--shutter {self.shutter:g}: must be 0 to 1 frame intervals")


def photograph_run(
    folder: Path,
    *,
    frames: Sequence[int] = (),
    settings: PhotoSettings | None = None,
    out: Path | None = None,
    on_progress: Callable[[int, int], None] = lambda done, of: None,
    estimated: Callable[[float], None] = lambda seconds: None,
    noted: Callable[[str], None] = lambda text: None,
) -> Iterator[Path]:
    """Render frames of a 3-D run as PNG images; yield each finished file.

    A picture contains its settings. An existing picture with the same settings is kept; one with
    other settings is rendered again.

    Args:
        folder: folder of the run.
        frames: numbers of frames, negative ones counted from the end. Default: all.
        settings: settings of the pictures.
        out: folder of the pictures. Default: `folder / "photo"`.
        on_progress: called with the number of finished pictures, and the total number.
        estimated: called with the estimated time on this machine's cores [s], before rendering
            begins.
        noted: called with notes on kept and repeated pictures.

    Raises:
        RenderError: the extra `photo` is missing, the run is 2-D, there are no such frames, or a
            picture cannot be written.
        SceneError: the run's scene cannot be read.
    """
    settings = settings or PhotoSettings()
    load_renderer()
    recording = Recording(folder, None, settings.show, settings.overrides)
    numbers, out = recording.chosen(frames), out or folder / "photo"
    scenes = PhotoScenes(
        recording, settings.size[0] / settings.size[1], beads=settings.show is VisiblePart.PARTICLES
    )
    files = {number: out / f"photo_{number:06d}.png" for number in numbers}
    wanted = {number: picture_settings(scenes, number, settings) for number in numbers}
    held = {number: read_settings(file) for number, file in files.items()}
    missing = [number for number in numbers if held[number] != wanted[number]]
    _report(noted, held, wanted, missing)
    if missing:
        variant = choose_variant()
        liquid = recording.scene.palette == "water" and recording.show is not VisiblePart.BODIES
        estimated(len(missing) * expected_seconds(settings, variant, liquid=liquid))
    on_progress(0, len(numbers))
    for done, number in enumerate(numbers, 1):
        if number in missing:
            quality = Quality(
                settings.size,
                settings.samples,
                settings.shutter / recording.scene.time.frames_per_second,
            )
            radiance = render_radiance(scenes.frame(number), quality, number, variant)
            _save(tone_mapped(radiance), wanted[number], files[number], folder)
        on_progress(done, len(numbers))
        yield files[number]


def photograph_film(
    folder: Path,
    film: Path,
    *,
    rate: float | None = None,
    frames: Sequence[int] = (),
    settings: PhotoSettings | None = None,
    out: Path | None = None,
    on_progress: Callable[[int, int], None] = lambda done, of: None,
    estimated: Callable[[float], None] = lambda seconds: None,
    noted: Callable[[str], None] = lambda text: None,
) -> Iterator[Path]:
    """Render frames as `photograph_run` does, then encode them into a film.

    Yields each finished picture.

    Args:
        folder: folder of the run.
        film: the file; `.mp4` or `.gif`.
        rate: frames per second of the film [1/s]. Default: that of the scene.
        frames: as of `photograph_run`.
        settings: likewise.
        out: likewise.
        on_progress: likewise.
        estimated: likewise.
        noted: likewise.

    Raises:
        RenderError: as in `photograph_run`, or the film cannot be written.
    """
    from PIL import Image

    film_suffix(film)
    files = []
    for file in photograph_run(
        folder,
        frames=frames,
        settings=settings,
        out=out,
        on_progress=on_progress,
        estimated=estimated,
        noted=noted,
    ):
        files.append(file)
        yield file
    settings = settings or PhotoSettings()
    with Film(film, settings.size, rate or Recording(folder).scene.time.frames_per_second) as reel:
        for file in files:
            reel.add(partial(lambda name: np.asarray(Image.open(name).convert("RGB")), file))


def frame_range(text: str, numbers: Sequence[int]) -> list[int]:
    """Return the frames from A to B, both included, of text `A:B`.

    Either number may be missing; negative ones count from the end.

    Raises:
        RenderError: the text has another format, or there is no such frame.
    """
    try:
        ends = [int(part) if part.strip() else None for part in text.split(":")]
    except ValueError:
        ends = []
    if len(ends) != 2:
        raise RenderError(
            f"--frames {text}: must be A:B, the first and the last frame, such as 10:40"
        )
    first, last = (
        None if end is None else numbers[end] if -len(numbers) <= end < 0 else end for end in ends
    )
    selected = [
        number
        for number in numbers
        if (first is None or first <= number) and (last is None or number <= last)
    ]
    if not selected:
        raise RenderError(
            f"--frames {text}: there are no such frames; the run has {numbers[0]} to {numbers[-1]}"
        )
    return selected


def expected_seconds(settings: PhotoSettings, variant: str, *, liquid: bool) -> float:
    """Return the estimated time of a picture on this machine's cores [s].

    Args:
        settings: settings of the picture.
        variant: variant of Mitsuba.
        liquid: whether light passes through liquid.
    """
    rate = (LIQUID_SECONDS if liquid else OPAQUE_SECONDS)[variant]
    return (
        1e-6 * math.prod(settings.size) * settings.samples * rate + GEOMETRY_SECONDS
    ) / core_count()


def core_count() -> int:
    """Return the number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def tone_mapped(radiance: np.ndarray) -> np.ndarray:
    """Return 8-bit pixels of scene-linear radiance."""
    return (
        255.0 * agx(EXPOSURE * radiance, contrast=CONTRAST, saturation=SATURATION) + 0.5
    ).astype(np.uint8)


def picture_settings(scenes: PhotoScenes, number: int, settings: PhotoSettings) -> Tables:
    """Return everything that determines a picture.

    The renderer's version, settings, camera, and checksums of the frame's files.
    """
    view = scenes.view
    camera = [*view.position, *view.focus, *view.up, view.angle]
    checksums = {
        file.name: zlib.crc32(file.read_bytes()) for file in scenes.recording.files(number)
    }
    return {
        "version": VERSION,
        "size": list(settings.size),
        "samples": settings.samples,
        "shutter": settings.shutter,
        "camera": [round(float(value), 9) for value in camera],
        "show": str(settings.show or scenes.recording.show),
        "frame": checksums,
    }


def read_settings(file: Path) -> Tables | None:
    """Return the settings stored in a picture.

    None if there is no complete picture, or it has no settings.
    """
    from PIL import Image

    try:
        with Image.open(file) as image:
            image.load()
            held = json.loads(image.info.get(SETTINGS_KEY, "null"))
    except (OSError, ValueError, SyntaxError):  # raised by Pillow for damaged files
        return None
    return held if isinstance(held, dict) else None


def _report(
    noted: Callable[[str], None],
    held: Mapping[int, Tables | None],
    wanted: Mapping[int, Tables],
    missing: Sequence[int],
) -> None:
    """Report which pictures are kept, and which are repeated and why."""
    if kept := len(wanted) - len(missing):
        noted(f"{kept} of {len(wanted)} pictures are there with these settings and are kept")
    outdated = {number: before for number in missing if (before := held[number]) is not None}
    if outdated:
        keys = sorted(
            {
                key
                for number, before in outdated.items()
                for key in wanted[number]
                if before.get(key) != wanted[number][key]
            }
        )
        noted(f"{len(outdated)} pictures have another {', '.join(keys)} and are rendered again")


def _save(pixels: np.ndarray, settings: Tables, file: Path, folder: Path) -> None:
    """Write a picture with its settings, in a run's folder never through a link."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    text.add_text(SETTINGS_KEY, json.dumps(settings))
    try:
        make_folder(file.parent, within=folder)
        with replacing(file) as stream:
            Image.fromarray(pixels).save(stream, format="PNG", pnginfo=text)
    except OSError as error:
        raise RenderError(f"{file}: cannot be written: {error.strerror}") from error
