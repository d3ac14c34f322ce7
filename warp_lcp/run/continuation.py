"""Rules for scene keys that change when a run is resumed."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from enum import Enum
from pathlib import Path

from warp_lcp.files import TableView
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import keys
from warp_lcp.scene.shapes import BUILTIN
from warp_lcp.scene.table import KeyFault, SceneError, written

RESOLUTION = "domain.resolution"
MAY_CHANGE = (
    "scene.name, scene.description, time.duration, time.cfl, time.dt_max, time.dt_min, [solver], "
    "[output], [camera], domain.follow and "
    "domain.resolution"
)


class Change(Enum):
    """Effect of a changed key on a resumed run."""

    SAME_STEPS = "the steps are those of a run that had this value from the start"
    OTHER_STEPS = "later steps differ from those of the original run"
    RESAMPLED = "the state is resampled to another grid"
    REFUSED = "not allowed: it would be a different run"


RULES = (
    (
        re.compile(r"scene\.(name|description)|time\.duration|(output|camera)\..*"),
        Change.SAME_STEPS,
    ),
    (re.compile(r"solver\..*|time\.(cfl|dt_max|dt_min)|domain\.follow"), Change.OTHER_STEPS),
    (re.compile(re.escape(RESOLUTION)), Change.RESAMPLED),
)
MESH_KEY = re.compile(r"\w+\[\d+\]\.file")


def change_of(key: str) -> Change:
    """Return the effect of a change of a key such as `time.cfl`."""
    return next((change for pattern, change in RULES if pattern.fullmatch(key)), Change.REFUSED)


def mesh_digests(scene: Scene) -> dict[str, str]:
    """Return a digest of each mesh file of a scene, by key (`solid[0].file`).

    Raises:
        SceneError: a file cannot be read.
    """
    digests = {}
    for key, value in keys(scene).items():
        if not MESH_KEY.fullmatch(key) or value.startswith(BUILTIN):
            continue
        try:
            with open(Path(value), "rb") as file:
                digests[key] = hashlib.file_digest(
                    file, lambda: hashlib.blake2b(digest_size=16)
                ).hexdigest()
        except OSError as error:
            raise SceneError(
                scene.scene.name,
                [KeyFault(key, f"cannot be read: {error.strerror}", written(value))],
            ) from error
    return digests


def fingerprint(scene: Scene, digests: Mapping[str, str] | None = None) -> str:
    """Return a digest of all keys that must not change when a run continues.

    Args:
        scene: the scene.
        digests: digests of its mesh files, which are compared by content and not by path; None:
            compute them.
    """
    files = mesh_digests(scene) if digests is None else digests
    fixed = {
        key: files.get(key, value)
        for key, value in keys(scene).items()
        if change_of(key) is Change.REFUSED
    }
    return hashlib.blake2b(json.dumps(fixed, sort_keys=True).encode(), digest_size=16).hexdigest()


def differences(before: TableView, after: TableView, *changes: Change) -> list[str]:
    """Return a line per changed key, such as `time.cfl: 2.0 before, 4.0 now`.

    Only keys whose effect is one of `changes`.
    """
    return [
        f"{key}: {written(before.get(key, 'none'))} before, {written(after.get(key, 'none'))} now"
        for key in sorted(before.keys() | after.keys())
        if before.get(key) != after.get(key) and change_of(key) in changes
    ]
