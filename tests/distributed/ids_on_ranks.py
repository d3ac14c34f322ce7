"""Ids of particles on ranks; `test_ids_on_ranks` starts this program.

`ids_on_ranks.py run,resume FOLDER`: one or both.
"""

import sys
from pathlib import Path

import numpy as np
from liquids_on_ranks import EAGER, FLAT, HEAP, RIVER, SCENES, advance, on_ranks, scene

from particle_tracks import TrackCheck
from small_liquids import box
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.simulation import Points

STEPS = 8
# A source across the cuts of the ranks.
ACROSS = [box([0.2, 0.3], [0.8, 0.4], velocity=[0.3, -1.0])]
CASES = {
    "river": FLAT | RIVER | {"source": [*RIVER["source"], *ACROSS]},
    "banded": SCENES["banded"],
    "sand": HEAP | {"source": ACROSS},
    "endless sand": SCENES["endless sand"] | {"solid": []},
}


def identified(name: str, *, ids: bool = True) -> ParticleScene:
    """Return a scene with ids."""
    tables = CASES[name]
    return scene(**(tables | {"output": tables.get("output", {}) | {"ids": ids}}))


def gathered(ranks: Ranks, simulation: ParticleSimulation) -> Points:
    """Return the particles of all ranks, by their ids."""
    parts = ranks.collect(simulation.points())
    fields = {
        name: np.concatenate([part.fields[name] for part in parts]) for name in parts[0].fields
    }
    order = np.argsort(fields["id"], kind="stable")
    points = np.concatenate([part.points for part in parts])[order]
    return Points("particles", points, {name: values[order] for name, values in fields.items()})


def run(ranks: Ranks, folder: Path) -> None:
    """Follow the ids on ranks, with repartitions, and write the last ones."""
    for name in CASES:
        simulation = on_ranks(ranks, identified(name))
        without = on_ranks(ranks, identified(name, ids=False)) if ranks.size == 2 else None
        both = [each for each in (simulation, without) if each is not None]
        check = TrackCheck(simulation.scene.domain.size, simulation.grid.spacing, endless(name))
        check.add(gathered(ranks, simulation), 0.0, 0.0)
        boxes = {str(simulation.grid.part.decomposition.parts)}
        for step in range(STEPS):
            if step == 3:
                for each in both:
                    each.grid.part.balance = EAGER
            row, *_ = [advance(each, 1)[0] for each in both]
            check.add(gathered(ranks, simulation), row["dt"], simulation.scene.time.cfl + 2.5)
            boxes.add(str(simulation.grid.part.decomposition.parts))
        births = simulation.births
        ranks.agree("the births", (births.first, births.times, births.next))
        if name in ("river", "banded"):
            assert len(boxes) > 1, "no repartition"
        state = simulation.state()
        for array, values in without.state().items() if without is not None else ():
            assert values.tobytes() == state[array].tobytes(), (name, array)
        np.savez(folder / f"{name}_piece_{ranks.size}_{ranks.rank}.npz", **state)
        points = gathered(ranks, simulation)
        if ranks.is_root:
            np.savez(
                folder / f"{name}_{ranks.size}.npz",
                points=points.points,
                next=births.next,
                **points.fields,
            )


def resume(ranks: Ranks, folder: Path) -> None:
    """Continue from the pieces of `run` on two ranks."""
    for name in CASES:
        pieces = [np.load(folder / f"{name}_piece_2_{rank}.npz") for rank in range(2)]
        before = np.load(folder / f"{name}_2.npz")
        simulation = on_ranks(ranks, identified(name))
        simulation.restore_pieces(pieces)
        points = gathered(ranks, simulation)
        for field in ("id", "age"):
            np.testing.assert_array_equal(points.fields[field], before[field])
        np.testing.assert_array_equal(points.points, before["points"])
        check = TrackCheck(simulation.scene.domain.size, simulation.grid.spacing, endless(name))
        check.add(points, np.inf, 0.0)
        check.born = int(before["next"]) - 1
        for _ in range(3):
            (row,) = advance(simulation, 1)
            check.add(gathered(ranks, simulation), row["dt"], simulation.scene.time.cfl + 2.5)


def endless(name: str) -> tuple[int, ...]:
    """Return the periodic axes of a scene."""
    return tuple(identified(name).endless)


if __name__ == "__main__":
    for part in sys.argv[1].split(","):
        {"run": run, "resume": resume}[part](Ranks.world(), Path(sys.argv[2]))
