"""Checkpoints: everything a run continues from, as plain arrays in an .npz file."""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from warp_lcp.driver.atomic import replacing

FORMAT = 2
CHECKPOINT_FILE = re.compile(r"step_(?P<step>\d{6,})\.npz")
REFUSED_FILE = re.compile(r"refused_\d{6,}\.npz")  # set aside when a run continued from an earlier one
STATE = "state/"
META = "meta"
PIECES = "pieces"  # the only array of a checkpoint whose state is in the files of ranks: a checksum of each


class CheckpointError(ValueError):
    """A file that a run cannot continue from. The message names it and says why."""


@dataclass(frozen=True)
class Checkpoint:
    """The state of a run after a step.

    Args:
        step: the number of steps taken.
        time: reached by them [s].
        state: the simulation's arrays.
        keys: of the scene that led there, with their values; not needed to write one.
    """

    step: int
    time: float
    state: Mapping[str, np.ndarray]
    keys: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def checksum(self) -> str:
        """A digest of the state."""
        return _checksum(self.state)


class CheckpointFolder:
    """The checkpoints of one run, `step_<number>.npz`.

    Args:
        folder: made when the first checkpoint is written.
        fingerprint: tells the run's scene from others, whatever may change when it goes on.
        keys: of the scene, with their values, written with each checkpoint.
    """

    def __init__(self, folder: Path, fingerprint: str, keys: Mapping[str, Any] | None = None) -> None:
        """Look at a folder."""
        self.folder = folder
        self.fingerprint = fingerprint
        self.keys = dict(keys or {})

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
            "keys": self.keys,
            "checksum": checkpoint.checksum,
        }
        arrays: dict[str, Any] = {META: np.array(json.dumps(meta))}
        arrays |= {STATE + name: array for name, array in checkpoint.state.items()}
        with replacing(self.path(checkpoint.step)) as temporary, open(temporary, "wb") as file:
            np.savez(file, **arrays)
        return self.path(checkpoint.step)

    def prune(self, kept: int) -> None:
        """Delete all but the newest `kept`.

        Raises:
            OSError: a file cannot be deleted.
        """
        for step in self.steps()[kept:]:
            self.path(step).unlink()

    def set_aside(self, after: int) -> list[Path]:
        """Rename what is newer than a step, so that it is neither continued from nor counted; return the new names.

        Raises:
            OSError: a file cannot be renamed.
        """
        return [self.path(step).replace(self.folder / f"refused_{step:06d}.npz") for step in self.steps() if step > after]

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
            written, time, keys = int(meta["step"]), float(meta["time"]), dict(meta.get("keys", {}))
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise CheckpointError(f"{path}: cut short, damaged or not a checkpoint ({error})") from error
        if found[0] != FORMAT:
            raise CheckpointError(f"{path}: written in format {found[0]}, this version reads format {FORMAT}")
        if found[1] != self.fingerprint:
            raise CheckpointError(f"{path}: belongs to another scene")
        foreign = [name for name in arrays if not name.startswith(STATE)]
        if foreign:
            raise CheckpointError(f"{path}: holds arrays that no run writes: {', '.join(foreign)}")
        checkpoint = Checkpoint(step, time, {name.removeprefix(STATE): array for name, array in arrays.items()}, keys)
        if found[2] != checkpoint.checksum:
            raise CheckpointError(f"{path}: damaged (its checksum does not fit)")
        if written != step:
            raise CheckpointError(f"{path}: holds step {written}, renamed")
        return checkpoint

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
