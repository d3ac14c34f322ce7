"""Folder of the recorded pressure problems of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from warp_lcp.files.atomic import make_folder, replacing, write_text
from warp_lcp.recorded_problem import DESCRIPTION, files
from warp_lcp.run.folder import OutputError
from warp_lcp.simulation import InputError

README = "README.md"


class ProblemError(InputError):
    """Invalid problem files, or a method that cannot solve the problem.

    The message names the file or the option.
    """


class ProblemFolder:
    """Files `problem_<step>.npz`, and a README.md about their content.

    Args:
        folder: the folder, created if needed.
        more: whether there may be problems already, of a resumed run.

    Raises:
        OutputError: the folder cannot be written, or holds another run's problems.
    """

    def __init__(self, folder: Path, *, more: bool = False) -> None:
        """Create the folder and its README.md."""
        self.folder = folder
        if not more and files(folder):
            raise OutputError(
                f"--record-problems {folder}: holds recorded problems already; name another folder"
            )
        try:
            make_folder(folder)
            write_text(folder / README, DESCRIPTION)
        except OSError as error:
            raise OutputError(f"--record-problems {folder}: {error}") from error

    def write(self, problem: Mapping[str, np.ndarray]) -> Path:
        """Write a problem atomically; a problem of a retried step is replaced.

        Raises:
            OSError: the file cannot be written; the earlier ones are intact.
        """
        path = self.folder / f"problem_{int(problem['step']):06d}.npz"
        with replacing(path) as file:
            np.savez_compressed(file, **problem)  # type: ignore[arg-type]
        return path
