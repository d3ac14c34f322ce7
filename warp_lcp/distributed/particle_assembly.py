"""Initial boxes of ranks for a scene with particles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warp_lcp.distributed.balance import Balance
from warp_lcp.distributed.decomposition import Decomposition, balanced_processes, pool
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.subdomain import DEFAULT_BALANCE, Subdomain, ghost_layers
from warp_lcp.grid.surface_mesh import surface_layers
from warp_lcp.material.particle_scene import ParticleScene

NOT_ON_RANKS = (
    "is not there on several processes (--engine petsc) yet: leave it out, or run on one process"
)

# Ghost layers besides those within reach of a cell: values between the outermost two centers are
# interpolated, and the ring has no velocity at its centers.
BESIDE = 2
ROUNDED = 1e-3  # cells; the longest reach in a message has four digits


def check_shared(
    scene: ParticleScene, ranks: Ranks, refused: Sequence[str], methods: Sequence[str]
) -> None:
    """Reject a scene that differs between ranks or cannot run on ranks; collective.

    Args:
        scene: the scene.
        ranks: that share it.
        refused: keys of the scene that are not available on ranks.
        methods: that solve problems of several ranks.

    Raises:
        ValueError: the message names the key and what is allowed; on all ranks.
    """
    ranks.agree("the scene", scene.model_dump(mode="json"))
    errors = [f"{key} {NOT_ON_RANKS}" for key in refused]
    if scene.domain.boundless:
        # Ranks share the whole domain: no grid follows the material.
        errors.append(
            "domain.spacing, an unbounded domain, works on one process only (without --engine "
            "petsc): give domain.size and domain.resolution"
        )
    if scene.solver.method not in methods:
        errors.append(
            f"solver.method = {scene.solver.method} works on one process only (without --engine "
            f"petsc): {' or '.join(methods)}"
        )
    if errors:
        raise ValueError("; ".join(errors))


def part_of(
    scene: ParticleScene,
    ranks: Ranks,
    device: str,
    *,
    methods: Sequence[str],
    refused: Sequence[str] = (),
    smoothing: int = 0,
    reach: tuple[str, float] | None = None,
    balance: Balance = DEFAULT_BALANCE,
) -> Subdomain:
    """Return this rank's part of the grid; collective.

    The ranks have about equal amounts of material, at the start and when it has come to rest.

    Args:
        scene: the scene, which must be the same on all ranks.
        ranks: that share it.
        device: a Warp device's name.
        methods: that solve problems of several ranks.
        refused: keys of the scene that are not available on ranks.
        smoothing: binomial passes over the level set.
        reach: key of the scene and its length [m], if a rank reads fields at that distance from its
            cells.
        balance: when to repartition.

    Raises:
        ValueError: as of `check_shared`, or the boxes are too small for `reach`; on all ranks.
    """
    check_shared(scene, ranks, refused, methods)
    counts, layers = scene.cell_counts, ghost_layers(scene.time.cfl, smoothing)
    if scene.output.surface:
        layers = max(
            layers, surface_layers(scene.output.surface_resolution or scene.particles.per_axis)
        )
    least = layers
    if reach is not None:
        layers = max(layers, math.ceil(reach[1] / scene.spacing - ROUNDED) + BESIDE)
    size = np.array([*scene.domain.size, scene.spacing][:3])
    start = []
    for shape in scene.materials()[1]:
        bounds = shape.bounds(scene.dimension)
        low, high = (
            (np.zeros(3), size)
            if bounds is None
            else (np.clip(corner, 0.0, size) for corner in bounds)
        )
        if scene.dimension == 2:
            low[2], high[2] = 0.0, scene.spacing
        start.append((low / scene.spacing, high / scene.spacing))
    volume = sum(float(np.prod(high - low)) for low, high in start)
    rest = pool(counts, scene.dimension, volume, np.array(scene.physics.gravity))
    states = [start, [rest]]
    processes = balanced_processes(counts, ranks.size, layers=layers, states=states)
    if processes is None and reach is not None:
        for fewer in range(layers - 1, least - 1, -1):
            if balanced_processes(counts, ranks.size, layers=fewer, states=states) is not None:
                raise ValueError(
                    f"{reach[0]} = {reach[1]:.4g} m reaches beyond the boxes of {ranks.size} "
                    f"ranks: at most {(fewer - BESIDE) * scene.spacing:.4g} m, or start fewer ranks"
                )
    decomposition = Decomposition(counts, ranks, processes=processes, periodic=scene.endless)
    return Subdomain(
        decomposition,
        spacing=scene.spacing,
        dimension=scene.dimension,
        device=device,
        layers=layers,
        balance=balance,
    )
