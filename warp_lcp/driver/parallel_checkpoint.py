"""Checkpoints that several ranks write: each its own piece, and the first one, when all are there, the file that makes them count."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.distributed.meeting import Meeting
from warp_lcp.driver.checkpoint import CHECKPOINT_FILE, PIECES, STATE, Checkpoint, CheckpointError, CheckpointFolder
from warp_lcp.driver.rank_folder import in_ranks, rank_folder


class StoredPiece(Mapping[str, np.ndarray]):
    """A rank's piece of a state in its file; an array is read when it is asked for.

    Args:
        path: of the file, which has been verified.
    """

    def __init__(self, path: Path) -> None:
        """Read the arrays' names."""
        self.path = path
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            self._names = [name.removeprefix(STATE) for name in file.files if name.startswith(STATE)]

    def __getitem__(self, name: str) -> np.ndarray:
        """Read an array."""
        if name not in self._names:
            raise KeyError(name)
        with open(self.path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            return np.asarray(file[STATE + name])

    def __iter__(self) -> Iterator[str]:
        """Iterate over the arrays' names."""
        return iter(self._names)

    def __len__(self) -> int:
        """Return the number of arrays."""
        return len(self._names)


class ParallelCheckpoints(CheckpointFolder):
    """The checkpoints of a run on several ranks: pieces `rank_0003/step_<number>.npz`, and `step_<number>.npz` with their checksums.

    A checkpoint counts from the moment that the latter is there. `write`, `complete` and `prune` are collective.

    Args:
        folder: made when the first checkpoint is written.
        fingerprint: as of `CheckpointFolder`.
        keys: as of `CheckpointFolder`.
        meeting: of the ranks.
    """

    def __init__(self, folder: Path, fingerprint: str, keys: Mapping[str, Any], meeting: Meeting) -> None:
        """Look at a folder."""
        super().__init__(folder, fingerprint, keys)
        self._meeting, self._ranks = meeting, meeting.ranks
        self._refused: dict[int, str] = {}
        self._continued: int | None = None  # the step that the run goes on from, whose pieces are not to be replaced

    def write(self, checkpoint: Checkpoint) -> Path:
        """Write a checkpoint.

        Args:
            checkpoint: with this rank's part of the state.

        Returns:
            The file of this rank's piece.

        Raises:
            OSError: a file cannot be written; the earlier checkpoints are intact.
            ValueError: an array holds Python objects, which would need a pickle.
        """
        if checkpoint.step == self._continued:
            return self.path(checkpoint.step)
        with self._meeting.together():
            self.folder.mkdir(exist_ok=True)
            file = self._of_rank(self._ranks.rank).write(checkpoint)
        checksums = self._meeting.exchange(checkpoint.checksum)
        with self._meeting.led():
            if self._ranks.first:
                super().write(Checkpoint(checkpoint.step, checkpoint.time, {PIECES: np.array(checksums)}))
        return file

    def read(self, step: int) -> Checkpoint:
        """Read and verify a checkpoint but for its pieces.

        Raises:
            CheckpointError: the file cannot be used, or its pieces were found not to be usable.
        """
        if step in self._refused:
            raise CheckpointError(self._refused[step])
        return super().read(step)

    def complete(self, checkpoint: Checkpoint) -> bool:
        """Verify the pieces of a checkpoint, each on one rank; without a valid one `read` refuses the checkpoint from now on."""
        problems = []
        checksums = checkpoint.state[PIECES]
        for rank in range(self._ranks.rank, len(checksums), self._ranks.size):
            folder = self._of_rank(rank)
            try:
                if folder.read(checkpoint.step).checksum != checksums[rank]:
                    problems.append(f"{folder.path(checkpoint.step)}: belongs to another checkpoint")
            except CheckpointError as error:
                problems.append(str(error))
        found = [problem for those in self._meeting.exchange(problems) for problem in those]
        if found:
            more = f" (and {len(found) - 1} other pieces)" if len(found) > 1 else ""
            self._refused[checkpoint.step] = found[0] + more
        return not found

    def pieces(self, checkpoint: Checkpoint) -> list[StoredPiece]:
        """Return the pieces of a checkpoint that is to be continued from.

        Raises:
            OSError: a file cannot be read.
        """
        self._continued = checkpoint.step
        return [StoredPiece(self._of_rank(rank).path(checkpoint.step)) for rank in range(len(checkpoint.state[PIECES]))]

    def prune(self, kept: int) -> None:
        """Delete all but the newest `kept`, and pieces that belong to none.

        Raises:
            OSError: a file cannot be deleted.
        """
        with self._meeting.led():
            if self._ranks.first:
                super().prune(kept)
                steps = self.steps()
                for step, piece in self._pieces():
                    if step not in steps:
                        piece.unlink()

    def set_aside(self, after: int) -> list[Path]:
        """Rename what is newer than a step, so that it is neither continued from nor counted; return the new names.

        Raises:
            OSError: a file cannot be renamed.
        """
        found = super().set_aside(after)
        for step, piece in self._pieces():
            if step > after:
                piece.replace(piece.with_name(f"refused_{step:06d}.npz"))
        return found

    def _of_rank(self, rank: int) -> CheckpointFolder:
        return CheckpointFolder(self.folder / rank_folder(rank), self.fingerprint)

    def _pieces(self) -> list[tuple[int, Path]]:
        """Return the pieces of all ranks with their steps."""
        matches = [(CHECKPOINT_FILE.fullmatch(file.name), file) for file in in_ranks(self.folder) if file.parent != self.folder]
        return [(int(match["step"]), file) for match, file in matches if match]
