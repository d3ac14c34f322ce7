"""Checkpoint format: the complete state of a run, as plain arrays in an .npz file.

Format 2: `step_000120.npz` has an array `meta`, a JSON text with format, digest of the scene, step,
time [s], keys of the scene and a checksum of the state; and an array `state/NAME` for each of
`Simulation.state`, without pickles. On ranks each state lies in `rank_0003/step_000120.npz`, and
`state/pieces_of_ranks` of `step_000120.npz` has their checksums. Files of another format are
refused.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from warp_lcp.distributed.collective import Collective, on_root
from warp_lcp.files import Tables, TableView
from warp_lcp.files.archive import Archive, ArchiveError
from warp_lcp.files.atomic import make_folder, replacing
from warp_lcp.frames.pieces import in_ranks, rank_folder

FORMAT = 2
CHECKPOINT_FILE = re.compile(r"step_(?P<step>[0-9]{6,})\.npz")
# Checkpoints that were renamed when a run continued from an earlier one.
REFUSED_FILE = re.compile(r"refused_[0-9]{6,}\.npz")
STATE = "state/"
META = "meta"
# The only array of a checkpoint with its state in the files of ranks: their checksums.
PIECES = "pieces_of_ranks"


class CheckpointError(ValueError):
    """A file that a run cannot continue from.

    The message names it and says why.
    """


@dataclass(frozen=True)
class Checkpoint:
    """State of a run after a step.

    Args:
        step: number of steps since the start.
        time: time after them [s].
        state: the simulation's arrays.
        keys: keys of the run's scene, with their values; not needed to write a checkpoint.
    """

    step: int
    time: float
    state: Mapping[str, np.ndarray]
    keys: TableView = field(default_factory=dict)

    @cached_property
    def checksum(self) -> str:
        """A digest of the state."""
        return _checksum(self.state)


class StoredPiece(Mapping[str, np.ndarray]):
    """A rank's part of a state in its file; arrays are read on access.

    Args:
        path: path of the file, which has been verified.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with Archive(path) as archive:
            self._names = [
                name.removeprefix(STATE) for name in archive.headers if name.startswith(STATE)
            ]

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        with Archive(self.path) as archive:
            return archive.read([STATE + name])[STATE + name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the arrays' names."""
        return iter(self._names)

    def __len__(self) -> int:
        """Return the number of arrays."""
        return len(self._names)


class CheckpointFolder:
    """Checkpoints of one run, `step_<number>.npz`.

    On several ranks the states are stored in parts, `rank_0003/step_<number>.npz`;
    `step_<number>.npz` has their checksums.

    Args:
        folder: the folder, created with the first checkpoint.
        fingerprint: digest of the scene without keys that may change when the run continues.
        keys: keys of the scene, with their values, written with each checkpoint.
        collective: collective operations of the ranks that share the run, whose checkpoints are in
            parts; `write`, `complete` and `prune` are then collective.

    Attributes:
        spared: steps whose checkpoints `prune` keeps, since missing output can be recomputed from
            them.
    """

    def __init__(
        self,
        folder: Path,
        fingerprint: str,
        keys: TableView | None = None,
        collective: Collective | None = None,
    ) -> None:
        self.folder, self.collective, self._in_pieces = (
            folder,
            collective or Collective.for_one_process(),
            collective is not None,
        )
        # Reasons why the parts of a step cannot be used, as found by its ranks.
        self._refused: dict[int, str] = {}
        # Step from which ranks continue, whose parts must not be replaced.
        self._continued: int | None = None
        self.fingerprint = fingerprint
        self.keys = dict(keys or {})
        self.spared: set[int] = set()

    def path(self, step: int) -> Path:
        """Return the file of a step."""
        return self.folder / f"step_{step:06d}.npz"

    def steps(self) -> list[int]:
        """Return the steps with files, newest first."""
        files = self.folder.iterdir() if self.folder.is_dir() else ()
        return sorted(
            (
                int(match["step"])
                for file in files
                if (match := CHECKPOINT_FILE.fullmatch(file.name))
            ),
            reverse=True,
        )

    def write(self, checkpoint: Checkpoint) -> Path:
        """Write a checkpoint atomically.

        On ranks, each one writes its part, then the root rank the file that completes them.

        Returns:
            The file of this rank's state.

        Raises:
            OSError: a file cannot be written; the earlier checkpoints are intact.
            ValueError: an array holds Python objects, which would need a pickle.
        """
        if not self._in_pieces:
            return self._write(checkpoint)
        if checkpoint.step == self._continued:
            return self.path(checkpoint.step)
        with self.collective.together():
            make_folder(self.folder, within=self.folder.parent)
            file = self.of_rank(self.collective.ranks.rank)._write(checkpoint)
        checksums = self.collective.exchange(checkpoint.checksum)
        with self.collective.root_only():
            if self.collective.ranks.is_root:
                self._write(
                    Checkpoint(checkpoint.step, checkpoint.time, {PIECES: np.array(checksums)})
                )
        return file

    def _write(self, checkpoint: Checkpoint) -> Path:
        """Write the file of this rank's state; return it."""
        pickled = [name for name, array in checkpoint.state.items() if array.dtype.hasobject]
        if pickled:
            raise ValueError(
                f"these arrays hold Python objects, which would need a pickle: {', '.join(pickled)}"
            )
        make_folder(self.folder, within=self.folder.parent)
        meta = {
            "format": FORMAT,
            "scene": self.fingerprint,
            "step": checkpoint.step,
            "time": checkpoint.time,
            "keys": self.keys,
            "checksum": checkpoint.checksum,
        }
        arrays: Tables = {META: np.array(json.dumps(meta))}
        arrays |= {STATE + name: array for name, array in checkpoint.state.items()}
        with replacing(self.path(checkpoint.step)) as file:
            np.savez(file, **arrays)
        return self.path(checkpoint.step)

    @on_root
    def prune(self, keep: int) -> None:
        """Delete all but the newest `keep` checkpoints and the spared ones.

        Parts without a checkpoint are deleted, too.

        Raises:
            OSError: a file cannot be deleted.
        """
        for step in self.steps()[keep:]:
            if step not in self.spared:
                self.path(step).unlink()
        steps = self.steps()
        for step, piece in self._all_pieces():
            if step not in steps:
                piece.unlink()

    def set_aside(self, after: int) -> list[Path]:
        """Rename checkpoints newer than a step, which are then ignored.

        Returns the new names.

        Raises:
            OSError: a file cannot be renamed.
        """
        for step, piece in self._all_pieces():
            if step > after:
                piece.replace(piece.with_name(f"refused_{step:06d}.npz"))
        return [
            self.path(step).replace(self.folder / f"refused_{step:06d}.npz")
            for step in self.steps()
            if step > after
        ]

    def read(self, step: int) -> Checkpoint:
        """Read and verify a checkpoint.

        Raises:
            CheckpointError: the file is truncated or damaged, of another version or of another
                scene.
        """
        path = self.path(step)
        try:
            with Archive(path) as archive:
                meta = _meta(archive)
                if meta["format"] != FORMAT:
                    raise CheckpointError(
                        f"{path}: written in format {meta['format']!r}, this version reads format "
                        f"{FORMAT}"
                    )
                if meta["scene"] != self.fingerprint:
                    raise CheckpointError(f"{path}: belongs to another scene")
                foreign = [
                    name for name in archive.headers if name != META and not name.startswith(STATE)
                ]
                if foreign:
                    raise CheckpointError(
                        f"{path}: holds unexpected arrays: {', '.join(map(repr, foreign))}"
                    )
                arrays = archive.read([name for name in archive.headers if name != META])
        except ArchiveError as error:
            raise CheckpointError(
                f"{path}: cut short, damaged or not a checkpoint ({error})"
            ) from error
        state = {name.removeprefix(STATE): array for name, array in arrays.items()}
        checkpoint = Checkpoint(step, float(meta["time"]), state, meta["keys"])
        if meta["checksum"] != checkpoint.checksum or np.ndim(state.get(PIECES, [])) != 1:
            raise CheckpointError(f"{path}: damaged (wrong checksum)")
        if meta["step"] != step:
            raise CheckpointError(f"{path}: holds step {meta['step']}; the file was renamed")
        return checkpoint

    def verify(self, checkpoint: Checkpoint) -> None:
        """Read and verify the parts of a checkpoint, if it has parts.

        Ranks have done this in `complete`.

        Raises:
            CheckpointError: a part cannot be used.
        """
        if checkpoint.step in self._refused:
            raise CheckpointError(self._refused[checkpoint.step])
        if self._in_pieces:
            return
        for rank in range(len(checkpoint.state.get(PIECES, ()))):
            if problem := self.problem(checkpoint, rank):
                raise CheckpointError(problem)

    def complete(self, checkpoint: Checkpoint) -> bool:
        """Verify the parts of a checkpoint, each on one rank.

        If a part is invalid, `newest` rejects the checkpoint from then on.
        """
        self._continued = checkpoint.step
        ranks = self.collective.ranks
        mine = range(ranks.rank, len(checkpoint.state.get(PIECES, ())), ranks.size)
        problems = [problem for rank in mine if (problem := self.problem(checkpoint, rank))]
        found = [problem for those in self.collective.exchange(problems) for problem in those]
        if found:
            more = f" (and {len(found) - 1} other pieces)" if len(found) > 1 else ""
            self._refused[checkpoint.step] = found[0] + more
        return not found

    def problem(self, checkpoint: Checkpoint, rank: int) -> str:
        """Return why a rank's part of a checkpoint cannot be used; "" if it can."""
        folder = self.of_rank(rank)
        try:
            if folder.read(checkpoint.step).checksum == checkpoint.state[PIECES][rank]:
                return ""
        except CheckpointError as error:
            return str(error)
        return f"{folder.path(checkpoint.step)}: belongs to another checkpoint"

    def pieces(self, checkpoint: Checkpoint) -> list[StoredPiece]:
        """Return the parts of a checkpoint, which have been verified.

        Raises:
            OSError: a file cannot be read.
        """
        return [
            StoredPiece(self.of_rank(rank).path(checkpoint.step))
            for rank in range(len(checkpoint.state[PIECES]))
        ]

    def of_rank(self, rank: int) -> CheckpointFolder:
        """Return the folder of a rank's parts."""
        return CheckpointFolder(self.folder / rank_folder(rank), self.fingerprint)

    def _all_pieces(self) -> list[tuple[int, Path]]:
        """Return the parts of all ranks with their steps."""
        matches = [
            (CHECKPOINT_FILE.fullmatch(file.name), file)
            for file in in_ranks(self.folder)
            if file.parent != self.folder
        ]
        return [(int(match["step"]), file) for match, file in matches if match]

    def newest(self) -> tuple[Checkpoint | None, list[str]]:
        """Return the newest valid checkpoint or None, and the errors of newer files."""
        refused: list[str] = []
        for step in self.steps():
            try:
                found = self.read(step)
                self.verify(found)
                return found, refused
            except CheckpointError as error:
                refused.append(str(error))
        return None, refused


def _meta(archive: Archive) -> Tables:
    """Return the metadata of a checkpoint: of format 2, with valid types.

    Raises:
        ArchiveError: the metadata is missing or invalid.
    """
    try:
        meta: Tables = json.loads(str(archive.read([META])[META]))
        if meta["format"] != FORMAT:
            return {"format": meta["format"]}
        meta = {"keys": {}, **meta}
        kinds = {"scene": str, "checksum": str, "step": int, "time": float | int, "keys": dict}
        wrong = [name for name, kind in kinds.items() if not isinstance(meta[name], kind)]
        if wrong or not 0.0 <= float(meta["time"]) < math.inf:
            raise ArchiveError(f"wrong in {META}: {', '.join(wrong) or 'time'}")
        return meta
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        raise ArchiveError(str(error)) from error


def _checksum(state: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(state):
        array = np.ascontiguousarray(state[name])
        digest.update(f"{name} {array.dtype.str} {state[name].shape};".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()
