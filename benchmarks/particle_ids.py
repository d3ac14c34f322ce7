"""Ids of particles: whether they last through a run, and their cost.

Check an inflow into a pool with a drain, 10^6 particles, on ranks and then on one process:

    mpiexec -n 3 python -m warp_lcp.benchmarks.particle_ids check FOLDER --ranks --steps 100
    python -m warp_lcp.benchmarks.particle_ids check FOLDER --steps 100

The second command continues from the state of the first. Each step must change the set of ids by
the log's counts of emitted, drained and departed particles alone, and a particle with an id before
and after a step must have moved by a few cells at most. `cost` runs two simulations in turns, with
and without ids, and compares their CPU time.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from warp_lcp.files import Tables
from warp_lcp.fluids import SIMULATOR, LiquidScene, LiquidSimulation
from warp_lcp.grid.grid_part import ONE_PROCESS, SerialCommunicator
from warp_lcp.run.stepping import stable_dt, take_step

MOST_CELLS = 3.5  # largest displacement in a step: CFL 2, its change in the step, a correction
SPACING, PER_AXIS = 1.0 / 32, 3  # [m], particles along a cell's edge
LONGEST = 0.01  # [s] of a step


def pool(particles: int, *, ids: bool) -> LiquidScene:
    """Return a pool with about as many particles, that falls into a box, a jet and a drain."""
    cells = particles / PER_AXIS**3
    count = 2 * round(0.5 * (cells / 1.2) ** (1.0 / 3.0))  # cells along width and height
    side = count * SPACING
    tables: dict[str, object] = {
        "scene": {"simulator": "fluids"},
        "time": {"duration": 1000.0, "dt_max": LONGEST},
        "domain": {
            "size": [2.0 * side, 1.5 * side, side],
            "resolution": 2 * count,
            "open": ["top"],
            "follow": False,
        },
        "particles": {"per_axis": PER_AXIS},
        "liquid": [{"shape": "box", "min": [0.0] * 3, "max": [1.2 * side, side, side]}],
        "source": [
            {
                "shape": "box",
                "min": [0.0, 1.2 * side, 0.3 * side],
                "max": [2 * SPACING, 1.4 * side, 0.7 * side],
                "velocity": [2.0, 0.0, 0.0],
            }
        ],
        "drain": [
            {
                "shape": "box",
                "min": [0.4 * side, 0.0, 0.4 * side],
                "max": [0.55 * side, 0.1 * side, 0.55 * side],
                "start": 0.1,
                "stop": 0.15,
            }
        ],
        "output": {"ids": ids},
    }
    return LiquidScene.model_validate(tables)


class IdTable:
    """Position of each id after the last step, and when it was seen.

    Attributes:
        next: the next id.
        step: number of the last step.
        where: positions by id [m], float32, shape (n, 3).
        seen: step after which an id was last seen, int32, shape (n,).
        longest: largest displacement in a step [cells].
        born, gone: particles that have come and gone.
    """

    def __init__(self) -> None:
        self.next, self.step = 0, -1
        self.where = np.zeros((0, 3), dtype=np.float32)
        self.seen = np.zeros(0, dtype=np.int32)
        self.longest, self.born, self.gone = 0.0, 0, 0

    def add(
        self, ids: np.ndarray, points: np.ndarray, step: int, row: Mapping[str, object]
    ) -> None:
        """Compare the particles after a step with those before it.

        Args:
            ids: ids, int64, shape (n,).
            points: positions [m], shape (n, 3).
            step: number of the step.
            row: log row of the step; empty for the start.

        Raises:
            AssertionError: ids are not those of the same particles.
        """
        more = max(int(ids.max(initial=-1)) + 1 - len(self.seen), 0)
        self.where = np.concatenate([self.where, np.zeros((more, 3), dtype=np.float32)])
        self.seen = np.concatenate([self.seen, np.full(more, -2, dtype=np.int32)])
        known = (self.seen[ids] == self.step) & (step > 0)
        assert (ids[~known] >= self.next).all(), "an id was used again"
        way = np.linalg.norm(points[known] - self.where[ids[known]], axis=1)
        cells = float(way.max(initial=0.0)) / SPACING
        before = int((self.seen == self.step).sum())
        assert cells <= MOST_CELLS, f"an id has jumped by {cells:.2f} cells"
        self.where[ids], self.seen[ids] = points, step
        assert int((self.seen == step).sum()) == len(ids), "an id occurs twice"
        if row:
            emitted, drained, departed = (
                int(str(row[name])) for name in ("emitted", "drained", "departed")
            )
            assert len(ids) - int(known.sum()) == emitted, "new ids without new particles"
            assert before - int(known.sum()) == drained + departed, "ids are lost"
            self.born += emitted
            self.gone += drained + departed
        self.longest = max(self.longest, cells)
        self.next, self.step = max(self.next, int(ids.max(initial=-1)) + 1), step

    def save(self, file: Path) -> None:
        """Write the table, for a run that continues."""
        np.savez(file, where=self.where, seen=self.seen, next=self.next, step=self.step)

    def load(self, file: Path) -> None:
        """Read a table of `save`."""
        with np.load(file) as saved:
            self.where, self.seen = saved["where"], saved["seen"]
            self.next, self.step = int(saved["next"]), int(saved["step"])


def check(folder: Path, particles: int, steps: int, *, on_ranks: bool) -> None:
    """Step, or continue a former check in the folder, and compare ids after each step."""
    ranks: SerialCommunicator = ONE_PROCESS
    scene = pool(particles, ids=True)
    if on_ranks:
        from warp_lcp.distributed.ranks import Ranks

        world = Ranks.world()
        simulation = SIMULATOR.create(scene, device="cpu", folder=Path(), ranks=world)
        collect, rank, is_root, size = world.collect, world.rank, world.is_root, world.size
    else:
        simulation = SIMULATOR.create(scene, device="cpu", folder=Path())
        collect, rank, is_root, size = ranks.collect, 0, True, 1
    table, files = IdTable(), sorted(folder.glob("piece_*.npz"))
    if files:
        simulation.restore_pieces([dict(np.load(file)) for file in files])
        if is_root:
            table.load(folder / "table.npz")
            print(f"continues {len(files)} pieces after step {simulation.step_count}", flush=True)
    row: Mapping[str, object] = {}
    for step in range(steps + 1):
        if step:
            _, _, row = take_step(simulation, stable_dt(simulation), np.inf, scene.time)
        points = simulation.points()
        parts = collect((points.fields["id"], points.points))
        if is_root and (step or not files):
            ids, places = (np.concatenate([part[n] for part in parts]) for n in range(2))
            table.add(ids, places, simulation.step_count, row)
            if step % 10 == 0:
                print(
                    f"step {simulation.step_count}: {len(ids)} particles on {size} processes, "
                    f"{table.next} ids, {table.born} born and {table.gone} gone, moved by at most "
                    f"{table.longest:.2f} cells",
                    flush=True,
                )
    for file in files if is_root else ():
        file.unlink()
    collect(None)
    folder.mkdir(parents=True, exist_ok=True)
    arrays: Tables = dict(as_piece(simulation))
    np.savez(folder / f"piece_{rank}.npz", **arrays)
    if is_root:
        table.save(folder / "table.npz")


def as_piece(simulation: LiquidSimulation) -> Mapping[str, np.ndarray]:
    """Return the state of a process as a piece of ranks."""
    from warp_lcp.material.particle_pieces import piece_of

    state = simulation.state()
    return state if "place" in state else piece_of(state)


def cost(particles: int, steps: int) -> None:
    """Print the CPU time of steps with ids, relative to those without, in turns."""
    both = [
        SIMULATOR.create(pool(particles, ids=ids), device="cpu", folder=Path())
        for ids in (True, False)
    ]
    seconds: list[list[float]] = [[], []]
    for step in range(steps):
        dt = min(stable_dt(both[1]), LONGEST)
        for which in (0, 1) if step % 2 else (1, 0):
            start = time.process_time()
            both[which].step(dt)
            seconds[which].append(time.process_time() - start)
    ratios = [on / off for on, off in zip(*seconds, strict=True)][8:]
    total = sum(seconds[0][8:]) / sum(seconds[1][8:])
    print(
        f"{both[0].particles.count} particles, {len(ratios)} steps of "
        f"{statistics.median(seconds[1]):.3f} s CPU: with ids {total:.4f} times in total, median "
        f"of steps {statistics.median(ratios):.4f}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("what", choices=("check", "cost"))
    parser.add_argument("folder", type=Path, nargs="?", default=Path("out/ids"))
    parser.add_argument("--particles", type=int, default=1_000_000)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--ranks", action="store_true", help="started by mpiexec")
    options = parser.parse_args()
    if options.what == "cost":
        cost(options.particles, options.steps)
    else:
        check(options.folder, options.particles, options.steps, on_ranks=options.ranks)
