"""Checkpoints: everything a run continues from, as plain arrays in an .npz file."""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.driver.atomic import replacing

FORMAT = 1
KEPT = 2  # checkpoints that stay while a run goes on; the final one is a third
CHECKPOINT_FILE = re.compile(r"step_(?P<step>\d{6,})\.npz")
STATE = "state/"
META = "meta"


class CheckpointError(ValueError):
    """A file that a run cannot continue from. The message names it and says why."""


@dataclass(frozen=True)
class Checkpoint:
    """The state of a run after a step.

    Args:
        step: the number of steps taken.
        time: reached by them [s].
        state: the simulation's arrays.
    """

    step: int
    time: float
    state: Mapping[str, np.ndarray]


class CheckpointFolder:
    """The checkpoints of one run, `step_<number>.npz`. `fingerprint` tells its scene from others."""

    def __init__(self, folder: Path, fingerprint: str) -> None:
        """Look at a folder; it is made when the first checkpoint is written."""
        self.folder = folder
        self.fingerprint = fingerprint

    def path(self, step: int) -> Path:
        """Return the file of a step."""
        return self.folder / f"step_{step:06d}.npz"

    def steps(self) -> list[int]:
        """Return the steps that there are files of, newest first."""
        files = self.folder.iterdir() if self.folder.is_dir() else ()
        return sorted((int(match["step"]) for file in files if (match := CHECKPOINT_FILE.fullmatch(file.name))), reverse=True)

    def write(self, checkpoint: Checkpoint) -> Path:
        """Write a checkpoint atomically.

        Raises:
            OSError: the file cannot be written; the earlier ones are intact.
            ValueError: an array holds Python objects, which would need a pickle.
        """
        pickled = [name for name, array in checkpoint.state.items() if array.dtype.hasobject]
        if pickled:
            raise ValueError(f"these arrays hold Python objects, which would need a pickle: {', '.join(pickled)}")
        self.folder.mkdir(exist_ok=True)
        meta = {
            "format": FORMAT,
            "scene": self.fingerprint,
            "step": checkpoint.step,
            "time": checkpoint.time,
            "checksum": _checksum(checkpoint.state),
        }
        arrays: dict[str, Any] = {META: np.array(json.dumps(meta))}
        arrays |= {STATE + name: array for name, array in checkpoint.state.items()}
        with replacing(self.path(checkpoint.step)) as temporary, open(temporary, "wb") as file:
            np.savez(file, **arrays)
        return self.path(checkpoint.step)

    def prune(self) -> None:
        """Delete all but the newest."""
        for step in self.steps()[KEPT:]:
            self.path(step).unlink()

    def read(self, step: int) -> Checkpoint:
        """Read and verify a checkpoint.

        Raises:
            CheckpointError: the file is cut short or damaged, of another version or of another scene.
        """
        path = self.path(step)
        try:
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:  # NumPy leaves a broken file open
                arrays = {name: file[name] for name in file.files}
            meta = json.loads(str(arrays.pop(META)))
            found = (meta["format"], meta["scene"], meta["checksum"])
            step, time = int(meta["step"]), float(meta["time"])
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise CheckpointError(f"{path}: cut short, damaged or not a checkpoint ({error})") from error
        if found[0] != FORMAT:
            raise CheckpointError(f"{path}: written in format {found[0]}, this version reads format {FORMAT}")
        if found[1] != self.fingerprint:
            raise CheckpointError(f"{path}: belongs to another scene")
        foreign = [name for name in arrays if not name.startswith(STATE)]
        if foreign:
            raise CheckpointError(f"{path}: holds arrays that no run writes: {', '.join(foreign)}")
        state = {name.removeprefix(STATE): array for name, array in arrays.items()}
        if found[2] != _checksum(state):
            raise CheckpointError(f"{path}: damaged (its checksum does not fit)")
        return Checkpoint(step, time, state)

    def newest(self) -> tuple[Checkpoint | None, list[str]]:
        """Return the newest valid checkpoint, if there is one, and what is wrong with each newer file."""
        refused: list[str] = []
        for step in self.steps():
            try:
                return self.read(step), refused
            except CheckpointError as error:
                refused.append(str(error))
        return None, refused


def _checksum(state: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(state):
        array = np.ascontiguousarray(state[name])
        digest.update(f"{name} {array.dtype.str} {state[name].shape};".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()
