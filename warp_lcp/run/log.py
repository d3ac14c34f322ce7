"""Log of a run, log.csv: a row per time step."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TextIO

from warp_lcp.distributed.collective import Collective, on_root
from warp_lcp.files.atomic import open_in_place, write_text
from warp_lcp.simulation import InputError

Value = float | int | str | None


class OutputError(InputError):
    """The output folder cannot be used for the run.

    The message says why and what to do.
    """


class Log:
    """CSV file with a row per step.

    A missing value is empty, never nan; every row is flushed at once. The root rank writes the
    file; methods are collective, so that a full disk ends all ranks.
    """

    def __init__(
        self,
        path: Path,
        columns: tuple[str, ...],
        *,
        after_step: int | None = None,
        collective: Collective | None = None,
    ) -> None:
        """Create a log, or continue one.

        Args:
            path: the file.
            columns: all of its columns; the first is `step`.
            after_step: continue an existing file after this step; later rows, and a truncated last
                row, are dropped.
            collective: collective operations of the ranks that share the run.

        Raises:
            OSError: the file cannot be written.
            OutputError: the existing file has other columns.
        """
        self.columns, self.collective = columns, collective or Collective.for_one_process()
        self._open(path, columns, after_step)

    @on_root
    def _open(self, path: Path, columns: tuple[str, ...], after_step: int | None) -> None:
        """Open the file for appending, after its header or the rows to keep."""
        header = ",".join(columns)
        lines = [header] if after_step is None else rows_until(path, header, after_step)
        write_text(path, "".join(f"{line}\n" for line in lines))
        opened = open_in_place(path, os.O_WRONLY | os.O_APPEND)
        # `close` closes the file.
        self._file: TextIO = open(  # noqa: SIM115
            opened, "a", buffering=1, encoding="utf-8", newline=""
        )
        self._writer = csv.DictWriter(self._file, columns, lineterminator="\n")

    @on_root
    def append(self, row: Mapping[str, Value]) -> None:
        """Write a row; missing columns are empty.

        Raises:
            OSError: the disk is full.
            ValueError: the row has a value for a column that the log lacks.
        """
        self._writer.writerow({name: _cell(value) for name, value in row.items()})

    @on_root
    def sync(self) -> None:
        """Wait until the rows are on the disk.

        Raises:
            OSError: the disk is full.
        """
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file; the only method that is not collective."""
        if self.collective.ranks.is_root:
            self._file.close()


def _cell(value: Value) -> Value:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        # NumPy scalars would be formatted differently.
        return float(value) if math.isfinite(value) else None
    return value


def rows_until(path: Path, header: str, step: int) -> list[str]:
    """Return the header of a log and its rows up to a step, in order.

    Incomplete rows are omitted.

    Args:
        path: the file, which may be missing.
        header: expected header; a truncated one is accepted.
        step: the last step.

    Raises:
        OutputError: the file has other columns.
    """
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else f"{header}\n"
    found, *rows = text.split("\n")[:-1] or [""]  # a line without a line break was truncated
    if found != header and (rows or not header.startswith(found)):
        raise OutputError(f"{path}: its columns are {found!r}, this run's are {header!r}")
    lines, last = [header], 0
    for row in rows:
        number = row.split(",", 1)[0]
        if (
            row.count(",") >= header.count(",")
            and number.isdecimal()
            and last < int(number) <= step
        ):
            lines.append(row)
            last = int(number)
    return lines
