"""Viewer window, on a plotter without a screen."""

import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from small_runs import ball, write_run
from warp_lcp.cli import commands as cli
from warp_lcp.extras.viewer import Viewer
from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.render.recording import Recording
from warp_lcp.render.render import INSTALL


class ManualClock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def folder(dots, tmp_path):
    return write_run(
        tmp_path / "run",
        [[ball([0.2 + 0.05 * n, 0.5, 0.5], 0.15)] for n in range(10)],
        size=(1.0, 1.0, 1.0),
    )


@pytest.fixture
def viewer(pyvista, folder):
    plotter = pyvista.Plotter(off_screen=True, window_size=[400, 300], lighting="none")
    viewer = Viewer(Recording(folder), plotter, ManualClock())
    yield viewer
    plotter.close()


def place_of_blue(viewer: Viewer) -> float:
    image = np.asarray(viewer.plotter.screenshot(return_img=True), dtype=int)[60:240]
    return float(np.nonzero(image[..., 2] - image[..., 0] > 50)[1].mean())


def test_steps_stay_in_the_run_and_move_the_picture(viewer):
    first = place_of_blue(viewer)
    viewer.step(1)
    assert viewer.place == 1
    viewer.step(-5)
    assert viewer.place == 0
    assert place_of_blue(viewer) == pytest.approx(first)
    viewer.step(100)
    assert viewer.place == 9
    assert place_of_blue(viewer) > first + 20


def test_playing_keeps_to_the_clock(viewer):
    viewer.tick()
    assert viewer.place == 0  # the viewer waits
    viewer.play()
    # 20 frames per second.
    for seconds, place in ((0.01, 0), (0.06, 1), (0.21, 4), (0.22, 4), (0.4, 8)):
        viewer.clock.now = seconds
        viewer.tick()
        assert viewer.place == place
    viewer.play()  # stop
    viewer.clock.now = 0.5
    viewer.tick()
    assert viewer.place == 8
    viewer.play()
    viewer.clock.now = 5.0
    viewer.tick()
    assert viewer.place == 9
    assert viewer.playing_since is None
    viewer.play()  # from the end: again from the start
    assert viewer.place == 0


def test_a_step_ends_playing(viewer):
    viewer.play()
    viewer.step(2)
    viewer.clock.now = 0.4
    viewer.tick()
    assert viewer.place == 2


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="elsewhere there always is a display"
)
def test_without_a_display_the_command_says_so(pyvista, folder, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    result = CliRunner().invoke(cli.app, ["view", str(folder)])
    assert result.exit_code == 2
    message = result.stderr.replace("\n", " ")
    assert "a window needs a display, and there is none" in message
    assert "--film film.mp4" in message


def test_frames_that_come_are_shown_where_the_newest_was(viewer, folder):
    def comes(number: int, seconds: float) -> None:
        FrameFolder(folder).write(number, number / 20, [ball([0.5, 0.5, 0.5], 0.2)])
        viewer.clock.now = seconds
        viewer.tick()

    comes(10, 1.1)
    assert viewer.place == 0, "who looks at another frame goes on looking at it"
    viewer.step(100)
    assert viewer.place == 10
    comes(11, 1.2)
    assert viewer.place == 10, "it looks once a second"
    comes(12, 2.2)
    assert viewer.place == 12


def test_wrong_input(pyvista, folder, tmp_path, monkeypatch):
    for arguments, expected in (
        ([tmp_path / "nowhere"], "no such folder"),
        ([folder, "--show", "particles"], "holds no frames"),
    ):
        result = CliRunner().invoke(cli.app, ["view", *map(str, arguments)])
        assert result.exit_code == 2
        assert expected in result.stderr.replace("\n", " ")
    monkeypatch.setitem(sys.modules, "pyvista", None)
    result = CliRunner().invoke(cli.app, ["view", str(folder)])
    assert result.exit_code == 2
    assert INSTALL in result.stderr
