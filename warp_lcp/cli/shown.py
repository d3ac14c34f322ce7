"""The commands that show what a run writes: `render`, `view`, `serve`, the last two while it is at work too; and `export`."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import timedelta
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from warp_lcp.cli.ending import wrong_input
from warp_lcp.render.film import check_rate
from warp_lcp.render.live import PORT, live_server, served
from warp_lcp.render.photo.photo import SAMPLES, SHUTTER, PhotoSettings, frame_range, photograph_film, photograph_run
from warp_lcp.render.recording import Color, Recording, RenderError, Show
from warp_lcp.render.render import Looks, film_run, parse_size, render_run
from warp_lcp.render.usd import export_run
from warp_lcp.render.viewer import view_run
from warp_lcp.run.devices import devices
from warp_lcp.run.progress import Count, Observer
from warp_lcp.run.terminal import Terminal, say, tell

RunArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a run.")]
ShowOption = Annotated[
    Show | None,
    typer.Option(
        help="What is shown; the surface where a run of liquid wrote one, else particles; bodies where the run has only those.",
        show_default=False,
    ),
]
ColorOption = Annotated[
    Color | None, typer.Option(help="What colors the particles, on one scale for the whole run; speed unless given.", show_default=False)
]
CameraOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="camera.KEY=VALUE", help="Override a key of the scene's table camera; may be repeated.")
]


class Look(StrEnum):
    """How images are drawn."""

    QUICK = "quick"
    PHOTO = "photo"


def render(
    folder: RunArgument,
    look: Annotated[Look, typer.Option(help="quick: OpenGL, with legends; photo: path-traced, 3-D.")] = Look.QUICK,
    frame: Annotated[
        list[int] | None, typer.Option(metavar="N", help="Draw frame N, counted from the end if negative; may be repeated.")
    ] = None,
    frames: Annotated[str | None, typer.Option(metavar="A:B", help="Draw frames A to B, both included.", show_default=False)] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="Pixels of an image; a sheet may be less high.")] = "1280x720",
    out: Annotated[Path | None, typer.Option(help="The images' folder; DIR/images, DIR/photo unless given.", show_default=False)] = None,
    show: ShowOption = None,
    color: ColorOption = None,
    sheet: Annotated[bool, typer.Option("--sheet", help="Draw the frames, or six of them, side by side into sheet.png.")] = False,
    film: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw all frames into FILE, an .mp4 or a .gif that repeats.", show_default=False)
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second of the film; the scene's unless given.", show_default=False)] = None,
    cut: Annotated[bool, typer.Option("--slice", help="Draw a section with Matplotlib, which needs no pyvista.")] = False,
    at: Annotated[
        float | None, typer.Option(metavar="Z", help="Where a 3-D run is cut, in meters; in its middle unless given.", show_default=False)
    ] = None,
    samples: Annotated[
        int | None, typer.Option(metavar="N", help="Photo: paths through a pixel; 64 unless given.", show_default=False)
    ] = None,
    shutter: Annotated[
        float | None, typer.Option(metavar="SHARE", help="Photo: exposure in frame intervals; 0.25 unless given.", show_default=False)
    ] = None,
    overrides: CameraOption = None,
) -> None:
    """Draw a run's frames as PNG images or as a film (needs the extra `render`, or `photo`)."""
    devices()  # starts Warp, which draws surfaces and samples 2-D solids, without its native messages
    console = Terminal(stderr=True)

    def estimated(seconds: float) -> None:
        say(console, f"drawing takes about {timedelta(seconds=math.ceil(seconds))}{'' if look is Look.PHOTO else ' of a core'}")

    with wrong_input(), Count(console, "drawing", "images") as told:
        frame = [*(frame or ()), *(frame_range(frames, Recording(folder, color, show).numbers) if frames else ())]
        if look is Look.PHOTO:
            if fps is not None and film is None:
                raise RenderError("--fps: is of a film; give --film")
            refuse_quick_options(sheet=sheet, slice=cut, at=at is not None, color=color is not None)
            exposure: Any = {"samples": SAMPLES if samples is None else samples, "shutter": SHUTTER if shutter is None else shutter}
            settings = PhotoSettings(size=parse_size(size), show=show, overrides=overrides or (), **exposure)
            draw = partial(photograph_film, film=film, rate=check_rate(fps)) if film else photograph_run
            report: Any = {"told": told, "estimated": estimated, "noted": partial(say, console)}
            images = list(draw(folder, frames=frame, settings=settings, out=out, **report))
            tell(f"{film}: {len(images)} frames" if film else _listed(images))
            return
        if samples is not None or shutter is not None:
            raise RenderError(f"--{'shutter' if samples is None else 'samples'}: is of --look photo")
        looks = Looks(size=parse_size(size), color=color, show=show, cut=cut, at=at, overrides=overrides or ())
        if film is not None:
            if frame or sheet or out:
                raise RenderError("--film: shows all frames in one file; leave out --frame, --frames, --sheet and --out")
            count = len(list(film_run(folder, film, looks=looks, rate=check_rate(fps), told=told, estimated=estimated)))
            tell(f"{film}: {count} frames")
            return
        if fps is not None:
            raise RenderError("--fps: is of a film; give --film")
        images = list(render_run(folder, frames=frame or (), looks=looks, out=out, sheet=sheet, told=told, estimated=estimated))
    tell(_listed(images))


def refuse_quick_options(**given: bool) -> None:
    """Refuse options that only `--look quick` has.

    Raises:
        RenderError: one of them is given.
    """
    for name, there in given.items():
        if there:
            raise RenderError(f"--{name}: is of --look quick")


def _listed(images: list[Path]) -> str:
    """Return which images there are."""
    return f"{images[0]}" if len(images) == 1 else f"{len(images)} images, {images[0]} to {images[-1].name}"


def view(folder: RunArgument, show: ShowOption = None, color: ColorOption = None, overrides: CameraOption = None) -> None:
    """Show a run in a window, frames as they come: Space plays, arrows step, the mouse turns (needs a display and the extra `render`)."""
    devices()
    with wrong_input():
        view_run(folder, Looks(color=color, show=show, overrides=overrides or ()))


def serve(
    folder: RunArgument,
    port: Annotated[int, typer.Option(min=0, max=65535, metavar="N", help="Of the loopback address; 0 takes a free one.")] = PORT,
    show: ShowOption = None,
) -> None:
    """Show a run on a page in the browser: its frames as they come, and plots of its log; Ctrl-C ends it."""
    devices()
    with wrong_input():
        if not folder.is_dir():
            raise RenderError(f"{folder}: there is no such folder; name the folder of a run, which may have just begun")
        server = live_server(folder, port=port, show=show)
    with server:
        tell(f"{folder}: {server.address}  (Ctrl-C ends)")
        with suppress(KeyboardInterrupt):
            server.serve_forever()


def export(
    folder: RunArgument,
    out: Annotated[Path, typer.Option(metavar="FILE", help="A .usdc, .usda (text) or .usd file.", show_default=False)],
    show: ShowOption = None,
    first: Annotated[int | None, typer.Option(metavar="N", help="The first frame; the run's unless given.", show_default=False)] = None,
    last: Annotated[int | None, typer.Option(metavar="N", help="The last frame; the run's unless given.", show_default=False)] = None,
) -> None:
    """Write a run's frames into one USD file, for Blender, Houdini and Maya (needs the extra `usd`)."""
    devices()
    with wrong_input(), Count(Terminal(stderr=True), "writing", "frames") as told:
        count = len(list(export_run(folder, out, show=show, first=first, last=last, told=told)))
    tell(f"{out}: {count} frames")


class _Begun:
    """An observer that passes on what it learns, and does something once the run begins."""

    def __init__(self, observer: Observer, begin: Callable[[], None]) -> None:
        self._observer, self._begin = observer, begin

    def __getattr__(self, name: str) -> Any:
        return getattr(self._observer, name)

    def start(self, time: float, end: float) -> None:
        """Learn the time [s] that the run begins and ends at."""
        self._observer.start(time, end)
        self._begin()


@contextmanager
def looked_on(observer: Observer, folder: Path, *, page: bool, window: bool) -> Iterator[Observer]:
    """Serve a page of a run, or show it in a window of a process of its own, from when its folder is there; the window stays."""
    with ExitStack() as stack:

        def begin() -> None:
            if page:
                observer.note(f"page: {stack.enter_context(served(folder))}")
            if window:
                program = "from warp_lcp.cli.commands import main; main()"
                subprocess.Popen([sys.executable, "-c", program, "view", str(folder.resolve())], start_new_session=True)

        yield cast(Observer, _Begun(observer, begin)) if page or window else observer
