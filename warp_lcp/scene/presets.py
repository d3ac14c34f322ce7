"""`[solver] preset`: defaults that trade speed for accuracy, from `presets.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Literal, TypeVar

from warp_lcp.files import Tables, TableView

if TYPE_CHECKING:
    from warp_lcp.scene.scene import Scene
    from warp_lcp.scene.table import Table

SceneT = TypeVar("SceneT", bound="Scene")
PresetName = Literal["preview", "standard", "final"]
PRESETS: tuple[PresetName, ...] = ("preview", "standard", "final")
TABLE = "presets.toml"
TRIAL_FRAMES = 18  # frames of the runs that measure distance and time of settings
Settings = Mapping[str, float]  # values by "section.key", such as time.cfl


@dataclass(frozen=True)
class Preset:
    """Accuracy and settings of a preset.

    Attributes:
        distance: largest displaced fraction of the mass relative to the simulator's reference run.
        volume: largest difference from that run in the growth of a liquid's volume, or in the
            packing of sand.
        settings: values of the scene's keys, by `section.key`.
    """

    distance: float
    volume: float
    settings: Settings


@dataclass(frozen=True)
class SimulatorPresets:
    """Presets and trial settings of one simulator.

    Attributes:
        presets: presets by name.
        reference: settings of the reference run.
        steps: lengths of a time step to try, (time.cfl, time.dt_max [s]), the longest first.
        tolerances: tolerances of the solver to try, the loosest first.
    """

    presets: Mapping[str, Preset]
    reference: Settings
    steps: tuple[tuple[float, float], ...]
    tolerances: tuple[float, ...]


@cache
def price_table() -> Mapping[str, SimulatorPresets]:
    """Return the entries of `presets.toml` by simulator."""
    read = tomllib.loads((files("warp_lcp.scene") / TABLE).read_text(encoding="utf-8"))
    entries = {}
    for simulator, part in read.items():
        presets: dict[str, Preset] = {
            name: Preset(part[name]["distance"], part[name]["volume"], _flat(part[name]))
            for name in PRESETS
        }
        steps = tuple((cfl, dt_max) for cfl, dt_max in part["steps"])
        entries[simulator] = SimulatorPresets(
            presets, _flat(part["reference"]), steps, tuple(part["tolerances"])
        )
    return entries


def fill_in(model: type[Scene], data: TableView) -> TableView:
    """Return a scene's raw data with the defaults of its preset.

    Keys in the data are kept; invalid data are left to the validation.

    Args:
        model: the scene's class, which knows the tables that turn a model on.
        data: the data of the file.
    """
    about, solver = data.get("scene"), data.get("solver")
    simulator = about.get("simulator") if isinstance(about, Mapping) else None
    name = solver.get("preset") if isinstance(solver, Mapping) else None
    if not isinstance(simulator, str) or simulator not in price_table() or name not in PRESETS:
        return data
    filled = dict(data)
    for table, values in _nested(price_table()[simulator].presets[name].settings).items():
        own = data.get(table, None if model.model_fields[table].default is None else {})
        if isinstance(own, Mapping):  # a model that is off stays off
            filled[table] = {**values, **own}
    return filled


def preset_values(scene: Scene, table: str) -> Tables:
    """Return the values of a scene's preset for a table; empty without a preset."""
    prices, name = price_table().get(scene.scene.simulator), scene.solver.preset
    return (
        _nested(prices.presets[name].settings).get(table, {})
        if prices is not None and name is not None
        else {}
    )


def preset_line(scene: Scene) -> str | None:
    """Return a line with the values of the preset and those of the scene.

    For the plan; None without a preset.
    """
    name = scene.solver.preset
    prices = price_table().get(scene.scene.simulator)
    if name is None or prices is None:
        return None
    own_values = {
        key: (value, value_of(scene, key)) for key, value in prices.presets[name].settings.items()
    }
    preset_values = [
        f"{key} {value:g}" for key, (value, is_now) in own_values.items() if is_now == value
    ]
    scene_values = [
        f"{key} {is_now:g}" if isinstance(is_now, float | int) else f"{key} {is_now}"
        for key, (value, is_now) in own_values.items()
        if is_now not in (value, None)
    ]
    return f"{name}: " + "; ".join(
        [
            *([", ".join(preset_values)] if preset_values else []),
            *([f"the scene's own: {', '.join(scene_values)}"] if scene_values else []),
        ]
    )


def table_of(scene: Scene, key: str) -> Table | None:
    """Return the table of `section.key`; None if the section is off."""
    table: Table | None = getattr(scene, key.partition(".")[0])
    return table


def value_of(scene: Scene, key: str) -> float | str | None:
    """Return the value at `section.key` of a scene; None if the section is off."""
    value: float | str | None = getattr(table_of(scene, key), key.partition(".")[2], None)
    return value


def changed(scene: SceneT, settings: Mapping[str, float | str]) -> SceneT:
    """Return a scene with other values at `section.key`.

    Those of models that are off are omitted.

    Raises:
        pydantic.ValidationError: a value is invalid in the scene.
    """
    data = scene.model_dump(by_alias=True, exclude_none=True)
    for key, value in settings.items():
        table, _, name = key.partition(".")
        if table_of(scene, key) is not None:
            data[table][name] = value
    return type(scene).model_validate(data)


def _nested(settings: Settings) -> dict[str, Tables]:
    """Return settings as tables of a scene."""
    tables: dict[str, Tables] = {}
    for key, value in settings.items():
        table, _, name = key.partition(".")
        tables.setdefault(table, {})[name] = value
    return tables


def _flat(part: TableView) -> Settings:
    """Return tables of a scene as settings."""
    return {
        f"{table}.{key}": value
        for table, keys in part.items()
        if isinstance(keys, Mapping)
        for key, value in keys.items()
    }
