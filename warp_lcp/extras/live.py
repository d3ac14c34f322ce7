"""Web page of a running simulation, on the loopback address.

It shows frames as they are written, and plots of the log. It needs only the core dependencies.
"""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from threading import Lock, Thread
from typing import cast
from urllib.parse import parse_qs, urlsplit

import numpy as np
import warp as wp

from warp_lcp.files import Tables
from warp_lcp.files.atomic import open_in_place
from warp_lcp.grid.motion import Motion, Pose
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.render.image_content import RenderError, VisiblePart
from warp_lcp.render.recording import PALETTES, Recording
from warp_lcp.render.solid_meshes import nearest_distance, prescribed_solids
from warp_lcp.run.folder import read_record
from warp_lcp.scene.camera import viewpoint
from warp_lcp.simulation import InputError

ClientAddress = tuple[str, int]  # of TCP/IP: host and port
Request = socket.socket | tuple[bytes, socket.socket]  # of `socketserver`; here a connection

LOOPBACK = "127.0.0.1"
# Host names accepted in requests, with any port, which may be forwarded. Others that resolve to
# this machine are refused (DNS rebinding).
HOST = re.compile(r"(?:127\.0\.0\.1|localhost)(?::\d{1,5})?")
PATIENCE = 10.0  # seconds without a byte after which a connection is closed
MOST_CONNECTIONS = 16  # most connections; a new one then replaces the oldest
# Most requests at a time, including those of closed connections; more are refused.
MOST_ANSWERED = 64
SHORTAGE = 0.2  # seconds
MOST_POINTS = 300_000  # approximate limit of a frame's particles; of more, a part is sent
# Lattice points along the longest side, of which those near a solid's surface are drawn.
SOLID_POINTS = {2: 512, 3: 96}
SAFE = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src "
    "'self'; img-src data:"
)


class QueryError(ValueError):
    """Invalid number in a request."""


@dataclass
class LiveRun:
    """Data of a run for the page; the run may be running or not yet started.

    Args:
        folder: folder of the run.
        show: part of the material to show; see `Recording`.
    """

    folder: Path
    show: VisiblePart | None = None

    def __post_init__(self) -> None:
        self._lock = Lock()  # requests run on threads of their own

    @cached_property
    def _recording(self) -> Recording:
        recording = Recording(self.folder, show=self.show)
        output, liquid = recording.scene.output, recording.scene.palette != "sand"
        # The surface of a frame is written after its particles.
        late = self.show is None and liquid and getattr(output, "surface", False)
        return Recording(self.folder, show=VisiblePart.SURFACE) if late else recording

    def state(self) -> Tables:
        """Return the numbers of the frames, and the data needed to draw them.

        The data exist once there is a frame.
        """
        record = read_record(self.folder)
        state: Tables = {
            "status": record.get("status", "not begun"),
            "reason": record.get("reason", ""),
            "frames": [],
        }
        with self._lock:
            try:
                numbers = self._recording.find_new_frames()
            except InputError as error:
                return state | {"waits": str(error)}
        scene = self._recording.scene
        view = viewpoint(scene, 1.0)
        return state | {
            "frames": numbers,
            "name": scene.scene.name,
            "dimension": scene.dimension,
            "size": [*scene.domain.size, 0.0][:3],
            "camera": {
                "position": list(view.position),
                "focus": list(view.focus),
                "up": list(view.up),
                "angle": view.angle,
            },
            "rate": scene.time.frames_per_second,
            "palette": PALETTES[scene.palette],
            "spacing": self._spacing,
        }

    def frame(self, number: int) -> bytes:
        """Return a frame as a line of JSON, followed by its arrays.

        The line is padded with spaces to whole words. The arrays are in the line's order, with 32
        bits per value.

        Raises:
            RenderError: there is no such frame, or it cannot be read.
        """
        with self._lock:
            recording = self._recording
            if number not in recording.find_new_frames():
                raise RenderError(f"there is no frame {number}")
            frame = recording.frame(number)
            solids = self._solid_points(frame.time)
        few = _few(len(frame.points), frame.ids)
        arrays: dict[str, np.ndarray] = {
            "points": frame.points[few],
            "values": frame.values[few],
            "solids": solids,
        }
        for name, surface in (("surface", frame.surface), ("bodies", frame.bodies)):
            if surface is not None:
                arrays |= {name: surface.points, f"{name}_corners": surface.corners}
        flat = {
            name: array.astype("<u4" if name.endswith("_corners") else "<f4").ravel()
            for name, array in arrays.items()
        }
        head = json.dumps(
            {"time": frame.time, "arrays": {name: len(array) for name, array in flat.items()}}
        ).encode()
        head += b" " * (-(len(head) + 1) % 4) + b"\n"
        return head + b"".join(array.tobytes() for array in flat.values())

    def log(self, begin: int) -> bytes:
        """Return the whole lines of the log from a byte on; empty at its end.

        Raises:
            OSError: the log cannot be read, or is a link to another file.
        """
        file = self.folder / "log.csv"
        if not file.is_file():
            return b""
        with open(open_in_place(file, os.O_RDONLY), "rb") as opened:
            opened.seek(min(begin, os.fstat(opened.fileno()).st_size))
            rows = opened.read()
        return rows[: rows.rfind(b"\n") + 1]

    @cached_property
    def _spacing(self) -> float:
        return self._recording.particle_spacing()

    @cached_property
    def _solids(self) -> list[tuple[Geometry, Motion | None]]:
        scene = self._recording.scene
        return [
            (
                solid.to_geometry(Path(), scene.dimension),
                solid.motion.to_motion(scene.dimension) if solid.motion else None,
            )
            for solid in prescribed_solids(scene)
        ]

    def _solid_points(self, time: float) -> np.ndarray:
        """Return points [m] on the solids' surfaces at a time, shape (n, 3)."""
        if not self._solids:
            return np.zeros((0, 3))
        scene = self._recording.scene
        step = max(scene.domain.size) / SOLID_POINTS[scene.dimension]
        axes = [np.arange(0.5 * step, side, step) for side in scene.domain.size]
        lattice = np.stack(np.meshgrid(*axes, *[[0.0]] * (3 - len(axes))), axis=-1).reshape(-1, 3)
        poses = [
            (geometry, motion.pose(time) if motion else Pose.identity())
            for geometry, motion in self._solids
        ]
        distance = nearest_distance(poses, wp.array(lattice, dtype=wp.vec3, device="cpu"))
        return np.asarray(lattice[np.abs(distance) < 0.6 * step])


class PageRequestHandler(BaseHTTPRequestHandler):
    """Request handler of the page, `/run`, `/frame?number=N` and `/log?from=BYTE`.

    No other paths are served.
    """

    server: LiveServer
    timeout = PATIENCE

    def do_GET(self) -> None:
        """Answer a request."""
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or not HOST.fullmatch(hosts[0]):
            return self._send_response(HTTPStatus.FORBIDDEN, b"this page is for this machine alone")
        try:
            answer, kind = self._answer()
        except QueryError as error:
            return self._send_response(HTTPStatus.BAD_REQUEST, str(error).encode())
        except InputError as error:
            return self._send_response(HTTPStatus.NOT_FOUND, str(error).encode())
        except OSError as error:
            return self._send_response(HTTPStatus.INTERNAL_SERVER_ERROR, str(error).encode())
        return self._send_response(HTTPStatus.OK, answer, kind)

    def _answer(self) -> tuple[bytes, str]:
        """Return the content of a request, and its type.

        Raises:
            QueryError: a number is invalid.
            InputError: there is no such content.
            OSError: a file cannot be read.
        """
        try:
            url = urlsplit(self.path)
            words = parse_qs(url.query)
        except ValueError as error:
            raise QueryError(f"invalid address: {error}") from error
        live = self.server.live
        if url.path == "/":
            return self.server.page, "text/html; charset=utf-8"
        if url.path == "/run":
            return json.dumps(live.state()).encode(), "application/json"
        if url.path == "/frame":
            return live.frame(_number(words, "number")), "application/octet-stream"
        if url.path == "/log":
            return live.log(_number(words, "from")), "text/csv; charset=utf-8"
        raise RenderError("no such page")

    def _send_response(
        self, status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8"
    ) -> None:
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(body))),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", SAFE),
            ("X-Content-Type-Options", "nosniff"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing, since the terminal belongs to the run."""


class LiveServer(ThreadingHTTPServer):
    """Web server of a run's page on the loopback address.

    Numbers of threads and descriptors are limited, since the run needs its own.
    """

    daemon_threads = True
    request_queue_size = 64  # waiting connections, which a busy run accepts late

    def __init__(self, live: LiveRun, port: int) -> None:
        self.live = live
        self._open: dict[socket.socket, None] = {}  # connections, the oldest first
        self._answered = 0  # requests in progress
        self._counting = Lock()
        self.page = files("warp_lcp.extras").joinpath("live.html").read_bytes()
        super().__init__((LOOPBACK, port), PageRequestHandler)

    @property
    def address(self) -> str:
        """Return the address for a browser."""
        return f"http://{LOOPBACK}:{self.server_port}/"

    def get_request(self) -> tuple[socket.socket, ClientAddress]:
        """Accept a connection; without a free descriptor, wait before the error.

        The server's loop would try again at once.
        """
        try:
            return super().get_request()
        except OSError:
            time.sleep(SHORTAGE)
            raise

    def process_request(self, request: Request, client_address: ClientAddress) -> None:
        """Answer on a thread; the oldest connection is closed if there are too many."""
        with self._counting:
            full = self._answered >= MOST_ANSWERED
            self._answered += 1
            while len(self._open) >= MOST_CONNECTIONS:
                oldest = next(iter(self._open))
                del self._open[oldest]
                with suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)  # its thread gets an error and closes it
            self._open[cast(socket.socket, request)] = None
        if full:
            return self.shutdown_request(request)
        return super().process_request(request, client_address)

    def shutdown_request(self, request: Request) -> None:
        """Close a connection, answered or not."""
        with self._counting:
            self._open.pop(cast(socket.socket, request), None)
            self._answered -= 1
        super().shutdown_request(request)

    def handle_error(self, request: Request, client_address: ClientAddress) -> None:
        """Ignore errors of closed browsers."""


def _few(count: int, ids: np.ndarray | None) -> slice | np.ndarray:
    """Return which of a frame's particles are sent.

    Without ids it is every second, third ... particle of the file. With ids it is those whose id is
    a multiple of 1, 2, 4, ...: the same particles in each frame, and some of them where the step
    doubles.

    >>> [_few(MOST_POINTS + 1, ids) for ids in (None, np.array([3, 6, 8]))]
    [slice(None, None, 2), array([False,  True,  True])]
    """
    step = count // MOST_POINTS + 1
    return slice(None, None, step) if ids is None else ids % (1 << (step - 1).bit_length()) == 0


def live_server(folder: Path, *, port: int, show: VisiblePart | None = None) -> LiveServer:
    """Return a server of a run's page, which answers once `serve_forever` runs.

    Raises:
        RenderError: the port is taken.
    """
    try:
        return LiveServer(LiveRun(folder, show), port)
    except OSError as error:
        raise RenderError(
            f"--port {port}: cannot be used: {error.strerror}; 0: any free port"
        ) from error


@contextmanager
def served(folder: Path, *, port: int) -> Iterator[str]:
    """Serve a run's page during a block, on a port if it is free, else on any other.

    The block gets the address, or the reason why there is none.
    """
    try:
        server = live_server(folder, port=port)
    except RenderError:
        try:
            server = live_server(folder, port=0)
        except RenderError as error:
            yield f"none ({error})"
            return
    with server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield server.address
        server.shutdown()


def _number(query: dict[str, list[str]], name: str) -> int:
    text = query.get(name, [""])[0]
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise QueryError(f"{name} must be a whole number of at most 15 digits")
    return int(text)
