"""Checkpoints that several ranks write: each its own piece, and the first one, when all are there, the file that makes them count."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.distributed.meeting import Meeting
from warp_lcp.frames.atomic import make_folder
from warp_lcp.run.checkpoint import PIECES, Checkpoint, CheckpointError, CheckpointFolder


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
            make_folder(self.folder)
            file = self.of_rank(self._ranks.rank).write(checkpoint)
        checksums = self._meeting.exchange(checkpoint.checksum)
        with self._meeting.led():
            if self._ranks.first:
                super().write(Checkpoint(checkpoint.step, checkpoint.time, {PIECES: np.array(checksums)}))
        return file

    def verify(self, checkpoint: Checkpoint) -> None:
        """Refuse a checkpoint whose pieces `complete` has found not to be usable.

        Raises:
            CheckpointError: it is one of those.
        """
        if checkpoint.step in self._refused:
            raise CheckpointError(self._refused[checkpoint.step])

    def complete(self, checkpoint: Checkpoint) -> bool:
        """Verify the pieces of a checkpoint, each on one rank; without a valid one `newest` refuses the checkpoint from now on."""
        self._continued = checkpoint.step
        mine = range(self._ranks.rank, len(checkpoint.state.get(PIECES, ())), self._ranks.size)
        problems = [problem for rank in mine if (problem := self.problem(checkpoint, rank))]
        found = [problem for those in self._meeting.exchange(problems) for problem in those]
        if found:
            more = f" (and {len(found) - 1} other pieces)" if len(found) > 1 else ""
            self._refused[checkpoint.step] = found[0] + more
        return not found

    def prune(self, kept: int) -> None:
        """Delete all but the newest `kept`, and pieces that belong to none.

        Raises:
            OSError: a file cannot be deleted.
        """
        with self._meeting.led():
            if self._ranks.first:
                super().prune(kept)
