"""Export a run's frames as one file of another program's format: USD or Alembic.

Needs the extra `usd` or `alembic`; the suffix of the file chooses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

from warp_lcp.extras import alembic, usd
from warp_lcp.files.atomic import make_folder, replacing_by_name
from warp_lcp.render.image_content import RenderError, VisiblePart
from warp_lcp.render.recording import Recording


class FrameFile(Protocol):
    """File that grows by frames."""

    def add(self, number: int) -> None:
        """Add a frame."""

    def saved_as(self, suffix: str) -> Path:
        """Close the file; return it, in the format of a suffix."""


@dataclass(frozen=True)
class ExportFormat:
    """Format of exported files.

    Args:
        name: name in messages.
        extra: extra of the package that installs it.
        suffixes: of its files.
        load: import its library; return the type of the library's errors.
        create: start a new file in a folder, for frames of a run.
        cause: the reason in an error of the library, in words.
    """

    name: str
    extra: str
    suffixes: tuple[str, ...]
    load: Callable[[], type[Exception]]
    create: Callable[[Path, Recording, Sequence[int]], FrameFile]
    cause: Callable[[Exception], str]

    @property
    def install(self) -> str:
        """Command that installs its library."""
        return f"pip install 'warp-lcp[{self.extra}]'"


FORMATS = (
    ExportFormat("USD", "usd", usd.SUFFIXES, usd.load, usd.UsdStage, usd.cause),
    ExportFormat(
        "Alembic", "alembic", alembic.SUFFIXES, alembic.load, alembic.AlembicArchive, alembic.cause
    ),
)


def export_run(
    folder: Path,
    file: Path,
    *,
    show: VisiblePart | None = None,
    first: int | None = None,
    last: int | None = None,
    on_progress: Callable[[int, int], None] = lambda done, of: None,
) -> Iterator[int]:
    """Write frames of a run into one file; yield the number of each written frame.

    y is up, lengths are in meters, velocities in meters per second. A time code of USD is the
    number of a frame, a time of Alembic that of the frame [s]. The file is created when it is
    complete.

    Args:
        folder: folder of the run.
        file: `.usdc` and `.usd` are binary USD, `.usda` is text; `.abc` is Alembic.
        show: part of the material to write; see `Recording`.
        first: number of the first frame. Default: that of the run.
        last: number of the last frame.
        on_progress: called with the number of written frames, and the total number.

    Raises:
        RenderError: the format's library is missing, there are no such frames, or the file cannot
            be written.
        SceneError: the run's scene cannot be read.
    """
    chosen = export_format(file)
    try:
        failure = chosen.load()
    except ImportError as error:
        raise RenderError(
            f"export needs {chosen.name}, which cannot be loaded ({error}): {chosen.install}"
        ) from error
    recording = Recording(folder, show=show)
    numbers = [
        number
        for number in recording.numbers
        if (first is None or first <= number) and (last is None or number <= last)
    ]
    if not numbers:
        requested = " ".join(
            f"--{name} {number}"
            for name, number in (("first", first), ("last", last))
            if number is not None
        )
        raise RenderError(
            f"{requested}: there are no such frames; the run has {recording.numbers[0]} to "
            f"{recording.numbers[-1]}"
        )
    try:
        make_folder(file.parent)
        with TemporaryDirectory(prefix=f".{file.name}.", dir=file.parent) as scratch:
            frames = chosen.create(Path(scratch), recording, numbers)
            on_progress(0, len(numbers))
            for done, number in enumerate(numbers, 1):
                frames.add(number)
                on_progress(done, len(numbers))
                yield number
            whole = frames.saved_as(file.suffix.lower())
            with replacing_by_name(file) as temporary:
                whole.replace(temporary)
    except (OSError, failure) as error:
        # Of the first error.
        why = error.strerror if isinstance(error, OSError) else chosen.cause(error)
        raise RenderError(f"{file}: cannot be written: {why}") from error


def export_format(file: Path) -> ExportFormat:
    """Return the format of a file, by its suffix.

    Raises:
        RenderError: it is not a suffix of a format, or the file is a folder.
    """
    suffix = file.suffix.lower()
    for one in FORMATS:
        if suffix in one.suffixes:
            if file.is_dir():
                raise RenderError(f"--out {file}: is a folder; name a file")
            return one
    *suffixes, last = (suffix for one in FORMATS for suffix in one.suffixes)
    raise RenderError(f"--out {file}: must end in {', '.join(suffixes)} or {last}")
