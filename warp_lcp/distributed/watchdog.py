"""Deadlock watchdog: names the rank that does not answer and aborts."""

from __future__ import annotations

import json
import math
import os
import secrets
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import Self

from warp_lcp.distributed.interruptible_wait import InterruptibleWait, waiting
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.files.atomic import SUFFIX, open_in_place

BEATS = 20  # heartbeats within the limit, which is checked as often
LONGEST_BEAT = 30.0  # seconds
# Beats, and seconds, after which a rank without a new heartbeat counts as dead: stopped, or its
# machine has failed.
SILENT, SILENCE = 4, 2.0
POST = r"waits_\d{4,}"  # names of the files
# Ranks that check one beat after another, so that only one of them reports; later ranks check only
# if those cannot.
FIRST = 5
# Seconds that it may take to end all ranks. After them this rank ends itself, which mpiexec
# notices.
GRACE = 5.0
ROOM = 512  # bytes of a heartbeat: overwritten in place, which works on a full disk
OWN = "warp_lcp."
# Modules that wait on behalf of their callers.
PASSING = {
    "contextlib",
    *(f"{OWN}distributed.{name}" for name in ("waiting", "ranks", "collective", "halo")),
}


@dataclass(frozen=True)
class HeartbeatMessages:
    """Heartbeat: state of a rank's main thread.

    Args:
        beat: a number that grows while the thread lives.
        count: of entries into collective operations, and exits.
        name: of the operation that the rank waits in, "" outside.
        seconds: since the count grew.
        place: in the program.
    """

    beat: int
    count: int
    name: str
    seconds: float
    place: str


class HeartbeatTable:
    """Heartbeat files, one a rank: communication while MPI is blocked.

    Args:
        folder: shared by the ranks; a rank that does not see it is ignored.
        label: tells the ranks of different programs apart in it.
    """

    def __init__(self, folder: Path, label: str = "") -> None:
        self._folder, self._label = folder, label

    def path(self, rank: int) -> Path:
        """Return the file of a rank."""
        return self._folder / f".{self._label}waits_{rank:04d}{SUFFIX}"

    def write(self, rank: int, post: HeartbeatMessages) -> None:
        """Write a heartbeat."""
        line = (json.dumps({**asdict(post), "place": post.place[: ROOM // 2]}) + "\n").encode()
        descriptor = open_in_place(self.path(rank), os.O_WRONLY | os.O_CREAT, 0o600)
        # The file is closed each time, so that other machines see the change.
        with open(descriptor, "wb") as file:
            file.write(line.ljust(ROOM))

    def read(self, rank: int) -> HeartbeatMessages | None:
        """Read the heartbeat of a rank.

        Returns None if there is none, or a half-written one.
        """
        with suppress(OSError, ValueError, TypeError):
            return HeartbeatMessages(**json.loads(self.path(rank).read_bytes().split(b"\n")[0]))
        return None

    def clear(self, ranks: Sequence[int]) -> None:
        """Remove the heartbeat files."""
        for rank in ranks:
            with suppress(OSError):
                self.path(rank).unlink()


class Watchdog:
    """A `with` block that ends all ranks once one keeps the others waiting too long.

    On each rank a thread writes a heartbeat several times within the limit: a small file with the
    state of its main thread. A rank that has waited for the limit reads the other heartbeats and
    names the late rank. Time in which processes are stopped, by Ctrl-Z or a batch system, does not
    count. Before there is a folder that all ranks see, heartbeats are shared on one machine.

    Args:
        ranks: all of them.
        limit: seconds that a rank may keep the others waiting; 0: any.
        end: takes the message, and ends all processes.
        watched: state of the main thread's collective operations.

    >>> from types import SimpleNamespace
    >>> with Watchdog(Ranks(SimpleNamespace(rank=0, size=1)), 600.0, print):  # a single rank
    ...     pass
    """

    def __init__(
        self,
        ranks: Ranks,
        limit: float,
        end: Callable[[str], object],
        *,
        watched: InterruptibleWait = waiting,
    ) -> None:
        """Agree on a label; collective."""
        self._ranks, self._limit, self._end, self._watched = ranks, limit, end, watched
        self._beat = min(limit / BEATS, LONGEST_BEAT)
        self._board = HeartbeatTable(
            Path(tempfile.gettempdir()), f"warp-lcp-{ranks.share(secrets.token_hex(8))}-"
        )
        self._posting = threading.Lock()
        self._over = threading.Event()
        self._main = threading.main_thread().ident
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        # Of each rank: first heartbeat without progress, last one, its age in beats.
        self._observed: dict[
            int, tuple[HeartbeatMessages | None, HeartbeatMessages | None, int]
        ] = {}

    def __enter__(self) -> Self:
        if self._limit and self._ranks.size > 1:
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(1.0)  # a limited wait: the file system may hang
        self._board.clear([self._ranks.rank])

    def post_in(self, folder: Path) -> None:
        """Write heartbeats to a folder that all ranks see, from now on."""
        with self._posting:
            self._board.clear([self._ranks.rank])
            self._board = HeartbeatTable(folder)
            if self._thread.is_alive():
                # Written at once, while the disk has room.
                self._board.write(
                    self._ranks.rank, HeartbeatMessages(0, 0, "", 0.0, "its beginning")
                )

    def _watch(self) -> None:
        beat, count, idle, then = 0, self._watched.count, 0.0, time.monotonic()
        while not self._over.wait(self._beat):
            now = time.monotonic()
            # now - then is longer if the process was stopped; that time does not count.
            beat, idle, then = beat + 1, idle + min(now - then, 2 * self._beat), now
            if count != self._watched.count:
                count, idle = self._watched.count, 0.0
            own_message = HeartbeatMessages(
                beat,
                count,
                self._watched.name,
                idle,
                place_of(sys._current_frames().get(self._main or 0)),
            )
            with self._posting:
                if self._over.is_set():
                    return
                # If the disk accepts no file, the other ranks report this one as silent.
                with suppress(OSError):
                    self._board.write(self._ranks.rank, own_message)
            if idle < self._limit + min(self._ranks.rank, FIRST) * self._beat:
                self._observed.clear()
            elif text := self._check_progress(own_message):
                threading.Timer(GRACE, os._exit, [1]).start()
                self._board.clear(range(self._ranks.size))
                self._end(f"{text}\nall ranks are aborted: --rank-timeout {self._limit:g}")
                return

    def _check_progress(self, own_message: HeartbeatMessages) -> str:
        """Return the error message; "" while ranks make progress.

        It is also "" until two different heartbeats of each rank, or none for long, show that it
        does not.
        """
        # A rank that computes waits for no other rank.
        patience = max(SILENT, math.ceil(SILENCE / self._beat), 0 if own_message.name else BEATS)
        posts: dict[int, HeartbeatMessages | None] = {self._ranks.rank: own_message}
        certain = True
        for rank in (rank for rank in range(self._ranks.size) if rank != self._ranks.rank):
            post = self._board.read(rank)
            first, last, age = self._observed.get(rank, (post, post, 0))
            if post and first and post.count != first.count:
                first = post  # the rank makes progress
            age = 0 if post and last and post.beat != last.beat else age + 1
            self._observed[rank] = first or post, post or last, age
            posts[rank] = None if age > patience else post or last
            certain = certain and (
                age > patience
                or (post is not None and first is not None and post.beat != first.beat)
            )
        return verdict(posts) if certain else ""


def verdict(posts: Mapping[int, HeartbeatMessages | None]) -> str:
    """Return a line about ranks that keep the others waiting; "" if there are none.

    Args:
        posts: heartbeats of all ranks, without progress for long; None: no heartbeat.
    """
    inside = {rank: post for rank, post in sorted(posts.items()) if post and post.name}
    outside = {rank: post for rank, post in sorted(posts.items()) if post and not post.name}
    silent = sorted(rank for rank, post in posts.items() if post is None)
    if not inside and not silent:
        return ""  # all ranks compute
    waits = _grouped({rank: f"{post.name} ({post.place})" for rank, post in inside.items()})
    if not outside and not silent:
        return f"all ranks wait for each other in different operations: {waits}"
    late = [
        f"rank {rank} has been at {post.place} for {post.seconds:.0f} s"
        for rank, post in outside.items()
    ]
    late += [
        f"{_named(silent)} sends no heartbeat: stopped, unreachable, or inside a library call that "
        "does not return"
    ] * bool(silent)
    if not inside:
        return "; ".join(late)
    who, seconds = sorted([*outside, *silent]), max(post.seconds for post in inside.values())
    keeps = "keep" if len(who) > 1 else "keeps"
    return (
        f"{_named(who)} of {len(posts)} {keeps} the others waiting: {'; '.join(late)}; {waits} "
        f"for {seconds:.0f} s"
    )


def place_of(frame: FrameType | None) -> str:
    """Return the position of a thread: the line in this library.

    Also the line of the module that it has called.
    """
    places = list[str]()
    while frame is not None:
        name, line = str(frame.f_globals.get("__name__", "")), frame.f_lineno
        if name not in PASSING and (name.startswith(OWN) or not places):
            places.append(f"{name}:{line}")
            if name.startswith(OWN):
                break
        frame = frame.f_back
    return " from ".join(places) or "its end"


def _named(ranks: Sequence[int]) -> str:
    return f"rank {ranks[0]}" if len(ranks) == 1 else f"ranks {', '.join(map(str, ranks))}"


def _grouped(texts: dict[int, str]) -> str:
    """Return text that groups ranks by the operation they wait in."""
    ranks: dict[str, list[int]] = {}
    for rank, text in texts.items():
        ranks.setdefault(text, []).append(rank)
    return "; ".join(f"{_named(those)} in {text}" for text, those in ranks.items())
