"""Commands that show or convert a run: render, view, serve, export.

Each imports its renderer when it runs.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from datetime import timedelta
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from warp_lcp.cli.exit_codes import wrong_input
from warp_lcp.render.image_content import Color, RenderError, VisiblePart
from warp_lcp.run.devices import devices
from warp_lcp.run.terminal import Terminal, print_lines, print_text

if TYPE_CHECKING:
    from warp_lcp.run.log import Value
    from warp_lcp.run.progress import Observer

PORT = 8765  # default port of a run's page
RunArgument = Annotated[Path, typer.Argument(metavar="DIR", help="Run folder.")]
ShowOption = Annotated[
    VisiblePart | None,
    typer.Option(
        help="Parts to show. Default: the surface if the run wrote one, else particles, else "
        "bodies.",
        show_default=False,
    ),
]
ColorOption = Annotated[
    Color | None,
    typer.Option(
        help="Color of the particles, on one scale for the whole run. Default: speed.",
        show_default=False,
    ),
]
CameraOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="camera.KEY=VALUE",
        help="Override a key of the scene's table camera; repeatable.",
    ),
]


class ImageRenderer(StrEnum):
    """Renderer of images."""

    QUICK = "quick"
    PHOTO = "photo"


def render(
    folder: RunArgument,
    look: Annotated[
        ImageRenderer, typer.Option(help="quick: OpenGL, with legends; photo: path-traced, 3-D.")
    ] = ImageRenderer.QUICK,
    frame: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N", help="Frame to draw; negative: from the end; repeatable. Default: all."
        ),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(metavar="A:B", help="Frames A to B, both included.", show_default=False),
    ] = None,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Image size in pixels; a sheet may be lower.")
    ] = "1280x720",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for images. Default: DIR/images or DIR/photo.", show_default=False
        ),
    ] = None,
    show: ShowOption = None,
    color: ColorOption = None,
    sheet: Annotated[
        bool,
        typer.Option(
            "--sheet", help="Draw the chosen frames, or six of all, side by side into sheet.png."
        ),
    ] = False,
    film: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Draw all frames into a film, .mp4 or (repeating) .gif.",
            show_default=False,
        ),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            help="Frames per second of the film. Default: the scene's.", show_default=False
        ),
    ] = None,
    cut: Annotated[
        bool, typer.Option("--slice", help="Draw a cross-section with Matplotlib, without pyvista.")
    ] = False,
    at: Annotated[
        float | None,
        typer.Option(
            metavar="Z",
            help="Position z of the cross-section of a 3-D run, in meters. Default: the middle.",
            show_default=False,
        ),
    ] = None,
    samples: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Photo: samples per pixel. Default: 64.", show_default=False
        ),
    ] = None,
    shutter: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="Photo: exposure time in frame intervals. Default: 0.25.",
            show_default=False,
        ),
    ] = None,
    overrides: CameraOption = None,
) -> None:
    """Draw the frames of a run as PNG images or a film.

    Needs the extra `render` or `photo`.
    """
    from warp_lcp.render.film import check_rate
    from warp_lcp.render.photo.photo import (
        SAMPLES,
        SHUTTER,
        PhotoSettings,
        frame_range,
        photograph_film,
        photograph_run,
    )
    from warp_lcp.render.recording import Recording
    from warp_lcp.render.render import ImageStyle, film_run, parse_size, render_run
    from warp_lcp.run.progress import ProgressCounter

    # Starts Warp, which draws surfaces and samples 2-D solids, without its native messages.
    devices()
    console = Terminal(stderr=True)

    def estimated(seconds: float) -> None:
        print_text(
            console,
            "drawing takes about "
            f"{timedelta(seconds=math.ceil(seconds))}"
            f"{'' if look is ImageRenderer.PHOTO else ' on one core'}",
        )

    with wrong_input(), ProgressCounter(console, "drawing", "images") as counter:
        frame = [
            *(frame or ()),
            *(frame_range(frames, Recording(folder, color, show).numbers) if frames else ()),
        ]
        if look is ImageRenderer.PHOTO:
            if fps is not None and film is None:
                raise RenderError("--fps: needs --film")
            refuse_quick_options(sheet=sheet, slice=cut, at=at is not None, color=color is not None)
            settings = PhotoSettings(
                size=parse_size(size),
                show=show,
                overrides=overrides or (),
                samples=SAMPLES if samples is None else samples,
                shutter=SHUTTER if shutter is None else shutter,
            )
            draw = (
                partial(photograph_film, film=film, rate=check_rate(fps))
                if film
                else photograph_run
            )
            images = list(
                draw(
                    folder,
                    frames=frame,
                    settings=settings,
                    out=out,
                    on_progress=counter,
                    estimated=estimated,
                    noted=partial(print_text, console),
                )
            )
            print_lines(f"{film}: {len(images)} frames" if film else _listed(images))
            return
        if samples is not None or shutter is not None:
            raise RenderError(
                f"--{'shutter' if samples is None else 'samples'}: needs --look photo"
            )
        looks = ImageStyle(
            size=parse_size(size), color=color, show=show, cut=cut, at=at, overrides=overrides or ()
        )
        if film is not None:
            if frame or sheet or out:
                raise RenderError(
                    "--film: draws all frames into one file; cannot be combined with --frame, "
                    "--frames, --sheet or --out"
                )
            count = len(
                list(
                    film_run(
                        folder,
                        film,
                        looks=looks,
                        rate=check_rate(fps),
                        on_progress=counter,
                        estimated=estimated,
                    )
                )
            )
            print_lines(f"{film}: {count} frames")
            return
        if fps is not None:
            raise RenderError("--fps: needs --film")
        images = list(
            render_run(
                folder,
                frames=frame or (),
                looks=looks,
                out=out,
                sheet=sheet,
                on_progress=counter,
                estimated=estimated,
            )
        )
    print_lines(_listed(images))


def refuse_quick_options(**options: bool) -> None:
    """Raise an error for options that only `--look quick` has.

    Raises:
        RenderError: one of them is set.
    """
    for name, there in options.items():
        if there:
            raise RenderError(f"--{name}: needs --look quick")


def _listed(images: list[Path]) -> str:
    """Return one line with the names of the images."""
    return (
        f"{images[0]}"
        if len(images) == 1
        else f"{len(images)} images, {images[0]} to {images[-1].name}"
    )


def view(
    folder: RunArgument,
    show: ShowOption = None,
    color: ColorOption = None,
    overrides: CameraOption = None,
) -> None:
    """Show a run in a window, also while it is in progress.

    Needs a display and the extra `render`.
    """
    from warp_lcp.extras.viewer import view_run
    from warp_lcp.render.render import ImageStyle

    devices()
    with wrong_input():
        view_run(folder, ImageStyle(color=color, show=show, overrides=overrides or ()))


def serve(
    folder: RunArgument,
    port: Annotated[
        int,
        typer.Option(
            min=0, max=65535, metavar="N", help="Port on the loopback address; 0: any free one."
        ),
    ] = PORT,
    show: ShowOption = None,
) -> None:
    """Show a run on a web page, also while it is in progress; Ctrl-C ends it."""
    from warp_lcp.extras.live import live_server

    devices()
    with wrong_input():
        if not folder.is_dir():
            raise RenderError(
                f"{folder}: no such folder; expected the folder of a run, finished or in progress"
            )
        server = live_server(folder, port=port, show=show)
    with server:
        print_lines(f"{folder}: {server.address}  (Ctrl-C ends)")
        with suppress(KeyboardInterrupt):
            server.serve_forever()


def export(
    folder: RunArgument,
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="File: .usdc, .usda (text) or .usd for USD, .abc for Alembic.",
            show_default=False,
        ),
    ],
    show: ShowOption = None,
    first: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="First frame. Default: the first of the run.", show_default=False
        ),
    ] = None,
    last: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Last frame. Default: the last of the run.", show_default=False
        ),
    ] = None,
) -> None:
    """Write a run to one USD or Alembic file, for Blender, Houdini and Maya.

    Needs the extra `usd` or `alembic`.
    """
    from warp_lcp.extras.export import export_run
    from warp_lcp.run.progress import ProgressCounter

    devices()
    with wrong_input(), ProgressCounter(Terminal(stderr=True), "writing", "frames") as told:
        count = len(
            list(export_run(folder, out, show=show, first=first, last=last, on_progress=told))
        )
    print_lines(f"{out}: {count} frames")


class _StartObserver:
    """Observer that forwards all events and calls a function at the start."""

    def __init__(self, observer: Observer, begin: Callable[[], None]) -> None:
        self._observer, self._begin = observer, begin

    def note(self, text: str) -> None:
        """Forward a remark."""
        self._observer.note(text)

    def step(self, row: Mapping[str, Value]) -> None:
        """Forward a step's log row."""
        self._observer.step(row)

    def frame(self, index: int, last: int) -> None:
        """Forward the number of a frame."""
        self._observer.frame(index, last)

    def start(self, time: float, end: float) -> None:
        """Forward start and end time [s], and call the function."""
        self._observer.start(time, end)
        self._begin()


@contextmanager
def show_while_running(
    observer: Observer, folder: Path, *, page: bool, window: bool
) -> Iterator[Observer]:
    """Show a web page or a window of a run once its folder exists.

    The window runs in another process, and stays open.
    """
    from warp_lcp.extras.live import served

    with ExitStack() as stack:

        def begin() -> None:
            if page:
                observer.note(f"page: {stack.enter_context(served(folder, port=PORT))}")
            if window:
                program = "from warp_lcp.cli.commands import main; main()"
                subprocess.Popen(
                    [sys.executable, "-c", program, "view", str(folder.resolve())],
                    start_new_session=True,
                )

        yield _StartObserver(observer, begin) if page or window else observer
