"""Whitewater on ranks; `test_whitewater_on_ranks` starts this program.

`whitewater_on_ranks.py run,resume FOLDER`: one or both.
"""

import sys
from pathlib import Path

import numpy as np
from liquids_on_ranks import EAGER, advance, on_ranks, scene

from small_liquids import box
from warp_lcp.distributed.particle_pieces import cells_of
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.fluids import LiquidScene
from warp_lcp.fluids.whitewater import COLUMNS, STATE

HALF, STEPS = 8, 16
LENGTH = 0.15  # 6 cells: more than the ghost layers of other liquids
MOST = 150  # particles, where the oldest go
RATES = {"trapped_air_rate": 2e6, "crest_rate": 2e5, "length": LENGTH}
SPLASH = {
    "size": [1.0, 0.5],
    "resolution": 40,
    "liquid": [box([0.0, 0.0], [1.0, 0.15]), box([0.35, 0.2], [0.65, 0.45], velocity=[1.5, -2.0])],
    "solver": {"precision": "double"},
}
DEEP = SPLASH | {
    "size": [1.0, 0.5, 0.25],
    "resolution": 24,
    "liquid": [
        box([0.0, 0.0, 0.0], [1.0, 0.15, 0.25]),
        box([0.35, 0.2, 0.0], [0.65, 0.45, 0.25], velocity=[1.5, -2.0, 0.5]),
    ],
}
CASES = {
    "splash": SPLASH | {"whitewater": RATES},
    "few": SPLASH | {"whitewater": RATES | {"max_particles": MOST}},
    "drained": SPLASH
    | {
        "domain": {"size": [1.0, 0.5], "resolution": 40, "open": ["right"]},
        "drain": [box([0.4, 0.0], [0.6, 0.05])],
        "whitewater": RATES,
    },
    "pillar": DEEP
    | {
        "solid": [box([0.7, 0.0, 0.1], [0.8, 0.3, 0.2])],
        "whitewater": RATES | {"trapped_air_rate": 5e7, "crest_rate": 5e6, "length": 0.12},
    },
}


def foaming(name: str) -> LiquidScene:
    """Return a scene with whitewater."""
    return scene(**CASES[name])


def gathered(ranks: Ranks, simulation) -> dict[str, np.ndarray]:
    """Return the whitewater of all ranks, sorted."""
    parts = ranks.collect(simulation.whitewater.state())
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in STATE}
    # The life is drawn once, and changes alike for all particles of a kind.
    order = np.lexsort([*arrays["whitewater_position"].T, *arrays["whitewater_state"].T[:1]])
    return {name: values[order] for name, values in arrays.items()}


def check(ranks: Ranks, simulation, row) -> None:
    """Check that each particle is in the box of its rank, and that the log has all of them."""
    part, position = simulation.grid.part, simulation.whitewater.state()["whitewater_position"]
    assert (part.owners(cells_of(part, position)) == ranks.rank).all()
    logged = {name: row[name] for name in COLUMNS}
    ranks.agree("the log", logged)
    assert sum(list(logged.values())[:3]) == ranks.sum(len(position))
    points = simulation.whitewater.points()
    assert len(points.points) == len(points.fields["age"]) == len(position)


def run(ranks: Ranks, folder: Path) -> None:
    """Step on ranks, with repartitions, and write logs, pieces and particles."""
    for name in CASES:
        simulation, logs, boxes = on_ranks(ranks, foaming(name)), [], set()
        for step in range(STEPS):
            if step == 3:
                simulation.grid.part.balance = EAGER
            (row,) = advance(simulation, 1)
            check(ranks, simulation, row)
            boxes.add(str(simulation.grid.part.decomposition.parts))
            logs.append([row[column] for column in COLUMNS])
            if step == 0:
                first = gathered(ranks, simulation)
            if step == HALF - 1:
                np.savez(
                    folder / f"{name}_piece_{ranks.size}_{ranks.rank}.npz", **simulation.state()
                )
        assert name != "splash" or len(boxes) > 1, "no repartition"
        last = gathered(ranks, simulation)
        if ranks.is_root:
            np.savez(folder / f"{name}_first_{ranks.size}.npz", **first)
            np.savez(folder / f"{name}_{ranks.size}.npz", logs=np.array(logs), **last)


def resume(ranks: Ranks, folder: Path) -> None:
    """Continue from the pieces of `run` on two ranks."""
    for name in CASES:
        pieces = [np.load(folder / f"{name}_piece_2_{rank}.npz") for rank in range(2)]
        simulation = on_ranks(ranks, foaming(name))
        simulation.restore_pieces(pieces)
        position = gathered(ranks, simulation)["whitewater_position"]
        assert len(position) == sum(len(piece["whitewater_position"]) for piece in pieces)
        simulation.grid.part.balance = EAGER
        for row in advance(simulation, STEPS - HALF):
            logged = [row[column] for column in COLUMNS]
        check(ranks, simulation, row)
        found = gathered(ranks, simulation)
        if ranks.is_root:
            np.savez(folder / f"{name}_resumed_{ranks.size}.npz", log=np.array(logged), **found)


if __name__ == "__main__":
    for part in sys.argv[1].split(","):
        {"run": run, "resume": resume}[part](Ranks.world(), Path(sys.argv[2]))
