"""Models of a scene, with the reason and the measured cost of each."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

TABLE = "models.toml"


@dataclass(frozen=True)
class SceneModel:
    """Part of a simulation that a scene turns on.

    Args:
        name: name in the cost table.
        why: key of the scene, or other reason, that requires it.
        built: False if it was requested, but has no effect; `why` then gives the reason.
        count: number of instances in the scene, such as rigid bodies; the cost is that of one.
    """

    name: str
    why: str
    built: bool = True
    count: int = 1


@dataclass(frozen=True)
class ModelCost:
    """Cost of a model, measured on one processor core.

    Args:
        fixed_seconds: per step, independent of the size [s]: launches and work of the host.
        cell_seconds: per step and cell of the domain [s].
        particle_seconds: per step and particle [s].
        cell_bytes: memory per cell.
        particle_bytes: memory per particle.
    """

    fixed_seconds: float = 0.0
    cell_seconds: float = 0.0
    particle_seconds: float = 0.0
    cell_bytes: float = 0.0
    particle_bytes: float = 0.0

    def seconds(self, cells: int, particles: int) -> float:
        """Return the cost per step [s]."""
        return self.fixed_seconds + self.cell_seconds * cells + self.particle_seconds * particles

    def bytes(self, cells: int, particles: int) -> int:
        """Return the cost in memory [bytes]."""
        return max(round(self.cell_bytes * cells + self.particle_bytes * particles), 0)


@cache
def prices(simulator: str, dimension: int) -> Mapping[str, ModelCost]:
    """Return the costs of models by name; `base`: the cost of every scene.

    Empty if nothing was measured.
    """
    read = tomllib.loads((files("warp_lcp.scene") / TABLE).read_text(encoding="utf-8"))
    return {
        name: ModelCost(**price)
        for name, price in read.get(simulator, {}).get(f"{dimension}d", {}).items()
    }


def predicted_seconds(
    models: Iterable[SceneModel], listed: Mapping[str, ModelCost], cells: int, particles: int
) -> float:
    """Return the estimated time of a step from the cost table [s]; 0: unknown."""
    counts = {"base": 1, **{model.name: model.count for model in models if model.built}}
    return (
        sum(
            n * listed[name].seconds(cells, particles)
            for name, n in counts.items()
            if name in listed
        )
        if "base" in listed
        else 0.0
    )


def model_lines(
    models: Sequence[SceneModel],
    listed: Mapping[str, ModelCost],
    cells: int,
    particles: int,
    *,
    memory: int,
    measured: float | None = None,
) -> list[tuple[str, str]]:
    """Return a line per model: reason, share of memory and of a step.

    As pairs of a word and a line.

    Args:
        models: models of a scene.
        listed: costs from `prices`.
        cells: number of cells of the domain.
        particles: largest number of particles.
        memory: memory of the whole run [bytes].
        measured: measured time of a step on this machine [s], which scales the table; None: times
            of the table.
    """
    predicted = predicted_seconds(models, listed, cells, particles)
    scale = measured / predicted if measured is not None and predicted > 0.0 else 1.0
    lines = []
    for model in models:
        text = f"{model.name}: {model.why}"
        if model.built and model.name in listed:
            price = listed[model.name]
            share = 100.0 * model.count * price.bytes(cells, particles) / memory if memory else 0.0
            seconds = max(model.count * price.seconds(cells, particles), 0.0)
            part = 100.0 * seconds / predicted if predicted > 0.0 else 0.0
            text += (
                f"; {share:.0f} % of memory, {1e3 * scale * seconds:.2g} ms a step ({part:.0f} %)"
            )
        lines.append(("model" if model.built else "not built", text))
    if predicted > 0.0:
        where = "here" if measured is not None else "by the cost table, on one core"
        lines.append(
            ("step", f"about {1e3 * scale * predicted:.3g} ms {where}, all models together")
        )
    return lines
