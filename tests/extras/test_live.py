"""Live page of a run, with requests like those of a browser."""

import errno
import json
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from http.client import HTTPConnection
from http.server import ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from typer.testing import CliRunner

from small_runs import MINIMAL, ball, write_run
from warp_lcp.cli import commands as cli
from warp_lcp.extras import live
from warp_lcp.extras.live import (
    LOOPBACK,
    MOST_ANSWERED,
    MOST_CONNECTIONS,
    LiveServer,
    PageRequestHandler,
    live_server,
)
from warp_lcp.frames.frame_folder import FrameFolder
from warp_lcp.frames.vtu import read_vtu
from warp_lcp.render.image_content import RenderError
from warp_lcp.simulation import Points

SOLID = "[[solid]]\nshape = 'sphere'\ncenter = [0.5, 0.5]\nradius = 0.2\n"


@contextmanager
def serving(folder: Path) -> Iterator[LiveServer]:
    with live_server(folder, port=0) as server:
        Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield server
        server.shutdown()


def ask(server: LiveServer, path: str, host: str | None = None) -> tuple[int, bytes]:
    connection = HTTPConnection(LOOPBACK, server.server_port, timeout=30)
    connection.request("GET", path, headers={"Host": host or f"localhost:{server.server_port}"})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


def arrays(body: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of a frame as the page reads them."""
    begin = body.index(b"\n") + 1
    assert begin % 4 == 0
    found = {}
    for name, length in json.loads(body[:begin])["arrays"].items():
        found[name] = np.frombuffer(
            body, "<u4" if name.endswith("_corners") else "<f4", length, begin
        )
        begin += 4 * length
    assert begin == len(body)
    return found


def test_solids_that_move_are_where_they_are(dots, tmp_path):
    motion = "motion = { kind = 'translation', velocity = [4.0, 0.0] }\n"
    folder = write_run(
        tmp_path / "run",
        [[dots_at([0.1, 0.1, 0.0])]] * 3,
        SOLID.replace("[0.5, 0.5]", "[0.3, 0.5]") + motion,
    )
    with serving(folder) as server:
        for number in range(3):
            status, body = ask(server, f"/frame?number={number}")
            assert status == 200
            points = arrays(body)["solids"].reshape(-1, 3)
            np.testing.assert_allclose(
                points.mean(axis=0), [0.3 + 4.0 * number / 20, 0.5, 0.0], atol=0.01
            )


def dots_at(*points: list[float]) -> Points:
    return Points(
        "particles",
        np.array(points, dtype=np.float32),
        {"velocity": np.full((len(points), 3), 2.0, dtype=np.float32)},
    )


def test_frames_reach_the_page_as_they_come(dots, tmp_path):
    folder = write_run(tmp_path / "run", [], SOLID)
    with serving(folder) as server:
        state = json.loads(ask(server, "/run")[1])
        assert state["frames"] == []
        assert "holds no frames" in state["waits"]
        FrameFolder(folder).write(0, 0.0, [dots_at([0.1, 0.2, 0.0], [0.3, 0.4, 0.0])])
        assert json.loads(ask(server, "/run")[1])["frames"] == [0]
        FrameFolder(folder).write(1, 0.05, [dots_at([0.1, 0.1, 0.0], [0.3, 0.3, 0.0])])
        state = json.loads(ask(server, "/run")[1])
        assert state["frames"] == [0, 1]
        assert (state["name"], state["dimension"], state["size"], state["rate"]) == (
            "drops",
            2,
            [1.0, 1.0, 0.0],
            20.0,
        )
        status, body = ask(server, "/frame?number=1")
    assert status == 200
    assert json.loads(body[: body.index(b"\n")])["time"] == pytest.approx(0.05)
    found = arrays(body)
    np.testing.assert_array_equal(
        found["points"].reshape(-1, 3), read_vtu(folder / "frames" / "particles_000001.vtu").points
    )
    np.testing.assert_allclose(found["values"], np.sqrt(12.0))
    radius = np.linalg.norm(found["solids"].reshape(-1, 3)[:, :2] - 0.5, axis=1)
    assert len(radius) > 100
    assert abs(radius - 0.2).max() < 0.6 / 512 + 1e-5


def test_of_many_particles_with_ids_the_same_are_shown(dots, tmp_path, monkeypatch):
    """A thinned frame shows the same ids in each frame, in any order of the file."""
    monkeypatch.setattr(live, "MOST_POINTS", 100)
    rng = np.random.default_rng(5)
    frames = []
    for _ in range(2):
        ids = rng.permutation(330)
        places = np.stack([ids / 330, 0.5 + 0.0 * ids, 0.0 * ids], axis=-1)
        part = dots_at(*places.tolist())
        frames.append([Points(part.name, part.points, part.fields | {"id": ids})])
    folder = write_run(tmp_path / "run", frames, SOLID)
    with serving(folder) as server:
        shown = [arrays(ask(server, f"/frame?number={n}")[1]) for n in range(2)]
    for found in shown:
        places = np.sort(found["points"].reshape(-1, 3)[:, 0])
        np.testing.assert_allclose(places, np.arange(0, 330, 4) / 330, atol=1e-6)
        assert len(found["values"]) == len(places)


def test_surfaces_and_bodies_are_triangles(dots, tmp_path):
    surface, body = ball([0.5, 0.5, 0.5], 0.2), ball([0.2, 0.5, 0.5], 0.1, "bodies", 0)
    folder = write_run(tmp_path / "run", [[surface, body]], size=(1.0, 1.0, 1.0))
    with serving(folder) as server:
        found = arrays(ask(server, "/frame?number=0")[1])
    np.testing.assert_array_equal(found["surface_corners"].reshape(-1, 3), surface.corners)
    np.testing.assert_array_equal(found["bodies"].reshape(-1, 3), body.points)
    assert len(found["points"]) == 0


def test_the_log_comes_in_whole_rows_from_where_one_stopped(dots, tmp_path):
    folder = write_run(tmp_path / "run", [])
    with serving(folder) as server:
        assert ask(server, "/log?from=0") == (200, b"")
        (folder / "log.csv").write_bytes(b"step,time\n1,0.1\n2,0.")
        assert ask(server, "/log?from=0")[1] == b"step,time\n1,0.1\n"
        (folder / "log.csv").write_bytes(b"step,time\n1,0.1\n2,0.2\n")
        assert ask(server, "/log?from=16")[1] == b"2,0.2\n"


def test_the_server_exposes_only_its_own_files_to_this_machine(dots, tmp_path):
    folder = write_run(tmp_path / "run", [[dots_at([0.1, 0.2, 0.0])]])
    with serving(folder) as server:
        assert server.server_address[0] == LOOPBACK
        assert ask(server, "/run", host="elsewhere.example")[0] == 403
        for path in (
            "/scene.toml",
            "/../run/scene.toml",
            "/frame",
            "/frame?number=-1",
            "/frame?number=7",
            "/log?from=x",
            "/frame?number=²",
        ):
            assert ask(server, path.replace("²", "%C2%B2"))[0] in (400, 404), path
        status, page = ask(server, "/")
        assert status == 200
        assert b"http://" not in page.replace(b"http://www.w3.org", b""), (
            "the page loads nothing from elsewhere"
        )
        assert b"https://" not in page
        taken = CliRunner().invoke(
            cli.app, ["serve", str(folder), "--port", str(server.server_port)]
        )
    assert taken.exit_code == cli.WRONG_INPUT
    assert f"--port {server.server_port}: cannot be used" in taken.stderr
    missing = CliRunner().invoke(cli.app, ["serve", str(tmp_path / "nowhere")])
    assert missing.exit_code == cli.WRONG_INPUT
    assert "no such folder" in missing.stderr


def test_a_run_is_served_and_shown_from_its_beginning(dots, tmp_path, monkeypatch):
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    scene.write_text(MINIMAL)
    opened = []

    def open_window(command: list[str], **_: object) -> None:
        assert (out / "scene.toml").is_file()
        opened.append(command[-2:])

    monkeypatch.setattr(subprocess, "Popen", open_window)
    monkeypatch.setenv("DISPLAY", ":0")
    pytest.importorskip("pyvista", reason="a window needs pyvista, the extra `render`")
    result = CliRunner().invoke(
        cli.app, ["run", str(scene), "--out", str(out), "--serve", "--view", "--device", "cpu"]
    )
    assert result.exit_code == 0, result.output
    assert "page: http://127.0.0.1:" in result.output
    assert opened == [["view", str(out)]]
    plain = CliRunner().invoke(
        cli.app, ["run", str(scene), "--out", str(tmp_path / "plain"), "--device", "cpu"]
    )
    assert plain.exit_code == 0 and "page:" not in plain.output and len(opened) == 1
    monkeypatch.delenv("DISPLAY")
    refused = CliRunner().invoke(
        cli.app, ["run", str(scene), "--out", str(tmp_path / "other"), "--view", "--device", "cpu"]
    )
    assert refused.exit_code == cli.WRONG_INPUT
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    "host",
    [
        "localhost:evil",
        "localhost:",
        "evil:80",
        "localhost.evil:80",
        "evil",
        "",
        "localhost:1@evil",
        "127.0.0.1.evil:80",
    ],
)
def test_other_names_of_this_machine_are_refused(dots, tmp_path, host):
    with serving(write_run(tmp_path / "run", [])) as server:
        with socket.create_connection((LOOPBACK, server.server_port), timeout=30) as connection:
            connection.sendall(f"GET / HTTP/1.0\r\nHost: {host}\r\n\r\n".encode())
            assert b" 403 " in connection.recv(4096)
        assert ask(server, "/", "localhost:9000")[0] == 200  # a forwarded port


@pytest.mark.parametrize(
    ("begin", "status"),
    [
        ("0", 200),
        ("5", 200),
        ("99999999999999", 200),
        ("999999999999999", 200),
        ("9999999999999999", 400),
        ("-1", 400),
        ("x", 400),
        ("", 400),
        ("1.5", 400),
        ("%E2%85%A7", 400),
        ("0x10", 400),
    ],
)
def test_the_log_from_any_byte(dots, tmp_path, begin, status):
    folder = write_run(tmp_path / "run", [])
    (folder / "log.csv").write_text("step,time\n1,0.5\n2,")
    with serving(folder) as server:
        answer = ask(server, f"/log?from={begin}")
    assert answer[0] == status
    if status == 200:
        assert answer[1] == b"step,time\n1,0.5\n"[int(begin) :]
    else:
        assert answer[1] == b"from must be a whole number of at most 15 digits"


def test_a_log_that_leads_elsewhere_is_not_shown(dots, tmp_path):
    (tmp_path / "secret").write_text("precious\n")
    folder = write_run(tmp_path / "run", [])
    (folder / "log.csv").symlink_to(tmp_path / "secret")
    with serving(folder) as server:
        status, body = ask(server, "/log?from=0")
    assert status == 500
    assert b"is a link" in body


def test_idle_connections_take_few_threads_and_descriptors(dots, tmp_path):
    """Few threads and descriptors for idle connections.

    The page is still served.
    """
    with serving(write_run(tmp_path / "run", [])) as server, ExitStack() as stack:
        before = threading.active_count()
        idle = []
        for _ in range(250):
            idle.append(
                stack.enter_context(
                    socket.create_connection((LOOPBACK, server.server_port), timeout=30)
                )
            )
            assert threading.active_count() - before <= MOST_ANSWERED
        assert ask(server, "/run")[0] == 200
        for connection in idle[:-MOST_CONNECTIONS]:
            assert connection.recv(1) == b""  # closed by the server
        assert ask(server, "/")[0] == 200
        while threading.active_count() - before > MOST_CONNECTIONS + 2:
            time.sleep(0.01)
        assert len(server._open) <= MOST_CONNECTIONS


def test_an_idle_connection_ends(dots, tmp_path, monkeypatch):
    monkeypatch.setattr(PageRequestHandler, "timeout", 0.1)
    with serving(write_run(tmp_path / "run", [])) as server:
        with socket.create_connection((LOOPBACK, server.server_port), timeout=30) as connection:
            connection.sendall(b"GET / HTTP/1.0\r\nHost: loc")
            assert connection.recv(1) == b""
        assert ask(server, "/")[0] == 200


def test_without_descriptors_the_page_waits(dots, tmp_path, monkeypatch):
    left, take = [3], ThreadingHTTPServer.get_request

    def get_request(self):
        left[0] -= 1
        if left[0] >= 0:
            raise OSError(errno.EMFILE, "Too many open files")
        return take(self)

    monkeypatch.setattr(live, "SHORTAGE", 0.01)
    monkeypatch.setattr(ThreadingHTTPServer, "get_request", get_request)
    with serving(write_run(tmp_path / "run", [])) as server:
        assert ask(server, "/")[0] == 200
    assert left[0] < 0


def test_a_run_goes_on_without_a_page(tmp_path, monkeypatch):
    def refuse(folder, *, port=0, show=None):
        raise RenderError("--port 0: cannot be used: Too many open files; 0: any free port")

    monkeypatch.setattr(live, "live_server", refuse)
    with live.served(tmp_path, port=0) as address:
        assert address.startswith("none (--port 0: cannot be used: Too many open files")
