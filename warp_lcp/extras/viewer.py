"""Window that shows a run's frames.

Needs a display and the extra `render`.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from warp_lcp.render.image_content import RenderError
from warp_lcp.render.page import INK
from warp_lcp.render.recording import Recording
from warp_lcp.render.render import INSTALL, ImageStyle
from warp_lcp.render.solid_meshes import EDGE
from warp_lcp.run.folder import read_record

if TYPE_CHECKING:
    import pyvista
    from vtkmodules.vtkInteractionWidgets import vtkSliderWidget

WINDOW = 1280, 720  # initial size in pixels
# Fallbacks of VTK without a display.
WITHOUT_SCREEN = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")
TICK = 20  # milliseconds between two checks of the clock
LOOK = 1.0  # seconds between two checks of a running run's folder
KEYS = "Space: play   Left, Right: step   Home, End   q: quit"
FOREVER = 2**31 - 1


class Viewer:
    """Frames of a run in a plotter, one at a time.

    Args:
        recording: frames of the run.
        plotter: plotter of pyvista.
        clock: returns seconds, for playing.
    """

    def __init__(
        self,
        recording: Recording,
        plotter: pyvista.Plotter,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        from warp_lcp.render.picture import Picture

        self.recording, self.plotter, self.clock = recording, plotter, clock
        self.picture = Picture(recording, plotter.window_size, plotter)
        self.place = 0  # index in the recording's frames
        # Time and index at the start of playing.
        self.playing_since: tuple[float, int] | None = None
        self._looked = clock()
        self._slider: vtkSliderWidget | None = None
        self._add_controls()
        self.go(0)

    def go(self, place: int) -> None:
        """Show the frame at an index, limited to the existing ones."""
        self.place = min(max(place, 0), len(self.recording.numbers) - 1)
        frame = self.recording.frame(self.recording.numbers[self.place])
        self.picture.place(frame)
        self.plotter.add_text(
            f"t = {frame.time:.3f} s",
            position="upper_left",
            font_size=12,
            color=INK,
            name="time",
            render=False,
        )
        if self._slider is not None:
            self._slider.GetRepresentation().SetValue(self.place)
        self.plotter.render()

    def step(self, by: int) -> None:
        """Stop playing and move forward or back by some frames."""
        self.playing_since = None
        self.go(self.place + by)

    def play(self) -> None:
        """Start or stop playing; at the end, start from the beginning."""
        if self.playing_since is not None:
            self.playing_since = None
            return
        if self.place == len(self.recording.numbers) - 1:
            self.go(0)
        self.playing_since = (self.clock(), self.place)

    def tick(self, _: int = 0) -> None:
        """Show the frame of the current time; omit frames if drawing is too slow."""
        if self.clock() - self._looked >= LOOK:
            self._add_new_frames()
        if self.playing_since is None:
            return
        since, begin = self.playing_since
        place = begin + int((self.clock() - since) * self.recording.scene.time.frames_per_second)
        if place >= len(self.recording.numbers):
            self.playing_since = None
        if place != self.place:
            self.go(place)

    def _add_new_frames(self) -> None:
        """Add new frames of a running run.

        If the last frame is shown, the newest one is shown next.
        """
        last, self._looked = len(self.recording.numbers) - 1, self.clock()
        newest = len(self.recording.find_new_frames()) - 1
        if newest > last:
            if self._slider is not None:
                self._slider.GetRepresentation().SetMaximumValue(newest)
            if self.place == last and self.playing_since is None:
                self.go(newest)

    def _add_controls(self) -> None:
        """Add keys, a slider and a timer to the plotter."""
        last = max(len(self.recording.numbers) - 1, 1)
        self.plotter.add_text(
            KEYS, position="upper_right", font_size=9, color=EDGE, name="keys", render=False
        )
        if self.plotter.iren is None:
            return
        self._slider = self.plotter.add_slider_widget(
            lambda value: (
                None if round(value) == self.place else self.step(round(value) - self.place)
            ),
            rng=[0, last],
            value=0,
            pointa=(0.25, 0.05),
            pointb=(0.75, 0.05),
            fmt="%.0f",
            color=INK,
            style="modern",
            slider_width=0.015,
            tube_width=0.004,
        )
        for key, action in (
            ("space", self.play),
            ("Right", lambda: self.step(1)),
            ("Left", lambda: self.step(-1)),
            ("Home", lambda: self.step(-self.place)),
            ("End", lambda: self.step(len(self.recording.numbers))),
        ):
            self.plotter.add_key_event(key, action)
        self.plotter.add_timer_event(FOREVER, TICK, self.tick)


def check_window(folder: Path) -> None:
    """Raise an error if no window can be opened.

    Raises:
        RenderError: pyvista or a display is missing.
    """
    try:
        import pyvista  # noqa: F401
    except ImportError as error:
        raise RenderError(
            f"a window needs pyvista, which cannot be loaded ({error}): {INSTALL}"
        ) from error
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise RenderError(_no_display("DISPLAY is not set", folder))


def view_run(folder: Path, looks: ImageStyle | None = None) -> None:
    """Show a run's frames in a window until it is closed.

    New frames of a running run are added; without frames it waits for the first.

    Raises:
        RenderError: pyvista or a display is missing, or there are no frames.
        SceneError: the run's scene cannot be read.
    """
    looks = looks or ImageStyle()
    while read_record(folder).get("status") == "running" and not any(folder.glob("frames/*")):
        time.sleep(LOOK)
    recording = Recording(folder, looks.color, looks.show, looks.overrides)
    check_window(folder)
    import pyvista

    plotter = pyvista.Plotter(
        window_size=list(WINDOW), lighting="none", title=f"{recording.scene.scene.name}: {folder}"
    )
    with closing(plotter):
        if plotter.off_screen or plotter.render_window.GetClassName() in WITHOUT_SCREEN:
            raise RenderError(_no_display("no window can be opened", folder))
        Viewer(recording, plotter)
        plotter.show(auto_close=False)


def _no_display(why: str, folder: Path) -> str:
    return (
        f"a window needs a display, and there is none ({why}); `warp-lcp render {folder} --film "
        "film.mp4` draws a film without one"
    )
