"""Scene of a new or resumed run, with its `--set` overrides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from warp_lcp.run.continuation import RESOLUTION
from warp_lcp.run.folder import SCENE, OutputError, holds_run, read_record, recorded_keys
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.scene_file import (
    SceneSource,
    keys,
    load_scene,
    override_key,
    override_value,
    scene_value,
)

# `set`: the override, `file`: the value in the scene's file, if it was read.
Overrides = list[dict[str, str]]


@dataclass(frozen=True)
class ResolvedScene:
    """Scene and its differences from its file.

    Args:
        scene: the scene.
        overrides: overrides for run.json, which a resumed run applies again.
        kept: overrides from earlier parts of the run.
    """

    scene: Scene
    overrides: Overrides = field(default_factory=list)
    kept: list[str] = field(default_factory=list)


def resolve_scene(source: SceneSource, overrides: Sequence[str]) -> ResolvedScene:
    """Return the scene of a new run.

    Args:
        source: see `load_scene`.
        overrides: see `load_scene`.

    Raises:
        SceneError: lists all errors.
    """
    return ResolvedScene(load_scene(source, overrides), _noted(source, overrides))


def scene_to_resume(folder: Path, source: str | None, overrides: Sequence[str]) -> ResolvedScene:
    """Return the scene of a resumed run.

    It is the folder's own scene, or the current `source` with the overrides since the run began. If
    a value in the file has changed since then, it was edited, and the edited value is used.
    `overrides` are applied last.

    Args:
        folder: folder of the run.
        source: see `load_scene`; the folder's own scene if None.
        overrides: see `load_scene`.

    Raises:
        OutputError: there is no run, or its grid would change without an explicit request.
        SceneError: lists all errors.
    """
    if not holds_run(folder):
        raise OutputError(f"{folder}: there is no run to resume")
    own_scene, new_keys = folder / SCENE, [override_key(override) for override in overrides]
    before = [entry for entry in _recorded(folder) if override_key(entry["set"]) not in new_keys]
    if source is None or (
        own_scene.is_file() and Path(source).is_file() and own_scene.samefile(source)
    ):
        return ResolvedScene(
            load_scene(own_scene, overrides),
            [*before, *({"set": override} for override in overrides)],
        )

    earlier = [entry["set"] for entry in before if not _edited(entry, source)]
    scene = load_scene(source, [*earlier, *overrides])
    ran, now = (recorded_keys(own_scene) or {}).get(RESOLUTION), keys(scene)[RESOLUTION]
    if ran not in (None, now) and RESOLUTION not in new_keys:
        raise OutputError(
            f"{folder}: {RESOLUTION} is {ran}, but {now} in {source}: use --set {RESOLUTION}={now} "
            "to resample to the other grid, "
            f"or --set {RESOLUTION}={ran} to keep the grid"
        )
    return ResolvedScene(scene, _noted(source, [*earlier, *overrides]), earlier)


def _edited(entry: Mapping[str, str], source: str) -> bool:
    """Return whether the file's value was edited since it was overridden.

    A value equal to the override does not count.
    """
    return "file" in entry and scene_value(source, entry["set"]) not in (
        entry["file"],
        override_value(entry["set"]),
    )


def _noted(source: SceneSource, overrides: Sequence[str]) -> Overrides:
    return [{"set": override, "file": scene_value(source, override)} for override in overrides]


def _recorded(folder: Path) -> Overrides:
    """Return the overrides in run.json; empty if it cannot be read."""
    return [entry for entry in read_record(folder).get("overrides", []) if "set" in entry]
