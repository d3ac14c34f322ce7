"""Bodies for tests, in a domain of 1 m with walls."""

import numpy as np

from warp_lcp.grid.grid_part import ONE_PROCESS
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import RigidBody
from warp_lcp.rigid.mass_properties import mass_properties
from warp_lcp.rigid.obstacles import domain_walls, obstacle

GRAVITY = np.array([0.0, -9.81, 0.0])
SIDES = 0b111111


def bodies_of(
    geometries,
    dimension,
    *,
    solids=(),
    open_sides=0,
    density=500.0,
    settings=None,
    ranks=ONE_PROCESS,
    **common,
):
    """Return bodies of shapes; `settings` holds further settings of each."""
    bodies = [
        RigidBody(
            mass_properties(shape, dimension, density=density),
            name=f"body {n}",
            **common,
            **(settings[n] if settings else {}),
        )
        for n, shape in enumerate(geometries)
    ]
    walls = domain_walls([1.0] * dimension, open_sides=open_sides)
    around = (walls, *(obstacle(solid, dimension) for solid in solids))
    return RigidBodies(
        bodies, geometries, [1 + n for n in range(len(geometries))], around, dimension, ranks=ranks
    )


def run(bodies, duration, dt=0.01, gravity=GRAVITY):
    """Advance without a material; return the kinetic energies after each step."""
    energies = []
    for _ in range(round(duration / dt)):
        bodies.begin_step(bodies.time, dt, gravity, dt)
        bodies.end_step(dt)
        energies.append(bodies.kinetic_energy())
    return np.array(energies)
