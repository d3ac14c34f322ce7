"""Families of small random problems: names, and functions of the seed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from warp_lcp.gallery.contact_scenes import contact
from warp_lcp.gallery.matrices import banded, definite, period_three, semidefinite, skewed
from warp_lcp.gallery.planted import PlantedSolution, poisson
from warp_lcp.host_problem import Problem


def _some(seed: int) -> np.random.Generator:
    """Return a random generator for a problem's size and settings.

    It is independent of the one for the problem's numbers.
    """
    return np.random.default_rng([seed, 20150205])


def _poisson(
    seed: int,
    *,
    plant: PlantedSolution,
    air: float = 0.0,
    solid: float = 0.0,
    coefficients: str = "uniform",
) -> Problem:
    rng = _some(seed)
    shape = tuple(
        int(n) for n in (rng.integers(3, 9, 2) if rng.random() < 0.5 else rng.integers(2, 5, 3))
    )
    return poisson(
        shape,
        plant=plant,
        air=air,
        solid=solid,
        coefficients=coefficients,
        seed=seed,
        dtype=wp.float64,
    )


FAMILIES: dict[str, Callable[[int], Problem]] = {
    "poisson": lambda seed: _poisson(seed, plant=PlantedSolution(active=_some(seed + 1).random())),
    "poisson-weak": lambda seed: _poisson(seed, plant=PlantedSolution(active=0.5, weak=0.5)),
    "poisson-boxed": lambda seed: _poisson(
        seed, plant=PlantedSolution(active=0.5, boxed=True, mixed=0.2)
    ),
    "poisson-cavities": lambda seed: _poisson(
        seed,
        plant=PlantedSolution(size=10.0 ** _some(seed + 1).integers(-6, 7)),
        air=0.1,
        solid=0.2,
        coefficients="random",
    ),
    "banded": lambda seed: banded(
        int(_some(seed).integers(8, 60)), bands=int(_some(seed).integers(1, 6)), seed=seed
    ),
    "banded-boxed": lambda seed: banded(
        int(_some(seed).integers(8, 60)), plant=PlantedSolution(boxed=True, mixed=0.2), seed=seed
    ),
    "definite": lambda seed: definite(
        int(_some(seed).integers(2, 40)), condition=10.0 ** _some(seed + 1).uniform(0, 4), seed=seed
    ),
    "definite-boxed": lambda seed: definite(
        int(_some(seed).integers(2, 40)),
        plant=PlantedSolution(boxed=True, mixed=0.2, active=0.5),
        seed=seed,
    ),
    "semidefinite": lambda seed: semidefinite(
        int(_some(seed).integers(4, 40)), zeros=_some(seed + 1).uniform(0, 0.8), seed=seed
    ),
    "skewed": lambda seed: skewed(int(_some(seed).integers(4, 40)), seed=seed),
    "period-three": lambda seed: period_three(
        int(_some(seed).integers(1, 5)),
        plant=PlantedSolution(active=_some(seed + 1).random()),
        seed=seed,
    ),
    "contact": lambda seed: contact(int(_some(seed).integers(1, 7)), seed=seed),
    "tiny": lambda seed: definite(int(_some(seed).integers(1, 5)), condition=10.0, seed=seed),
}
