"""Ids on ranks: unique, lasting, and those of one process."""

from pathlib import Path

import ids_on_ranks
import numpy as np
import pytest
from ids_on_ranks import CASES, STEPS, gathered, identified
from liquids_on_ranks import advance
from ranks_in_turn import RankInTurn, on_ranks
from test_shared_particles import SPACING, cells_of, part_of, scattered

from warp_lcp.distributed.ranks import Ranks
from warp_lcp.grid.particle_ids import ParticleIds, cell_numbers
from warp_lcp.grid.particles import SORT_EVERY, Particles
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.scene.simulator import simulators

PROGRAM = Path(ids_on_ranks.__file__)
TESTS = Path(__file__).parents[1]
# The number of fresh particles of the band depends on rounding of the solve.
ROUNDED = ("banded",)


@pytest.mark.parametrize(
    ("counts", "size"), [((24, 12, 1), 2), ((24, 20, 1), 4), ((18, 10, 11), 3), ((12, 12, 12), 8)]
)
def test_ids_do_not_depend_on_the_number_of_ranks(counts, size):
    """Ids of particles at the start, of ones added later, and after migration."""
    position, velocity = scattered(counts, 900)
    late, _ = scattered(counts, 1300)
    late = late[900:]
    grid = StaggeredGrid(counts, SPACING, 2 if counts[2] == 1 else 3, "cpu")
    alone, births = Particles(grid, position, velocity, affine=False, ids=True), ParticleIds()
    alone.sort()
    births.give(alone, 0, grid.part, 0.0)
    alone.append(late, np.zeros_like(late))
    births.give(alone, 900, grid.part, 1.0, cell_numbers(grid, late))
    expected = dict(zip(alone.ids.tolist(), alone.position.numpy().tolist(), strict=True))
    assert len(expected) == 1300

    def work(seat: RankInTurn) -> list[tuple[np.ndarray, np.ndarray]]:
        part, own_births = part_of(seat, counts), ParticleIds()
        own, own_late = (
            array[part.owners(cells_of(array)) == seat.rank] for array in (position, late)
        )
        particles = Particles(part.grid, own, np.zeros_like(own), affine=False, ids=True)
        particles.sort()
        own_births.give(particles, 0, part, 0.0, particles.exchange.last_cells(0))
        begin = particles.count
        particles.append(own_late, np.zeros_like(own_late))
        own_births.give(particles, begin, part, 1.0, cell_numbers(part.grid, own_late))
        assert vars(own_births) == vars(births)
        found = []
        for step in range(SORT_EVERY + 2):
            particles.arrange(step)
            particles.drop_ghosts()
            found.append((particles.ids, particles.position.numpy().copy()))
        return found

    ranks = on_ranks(size, work)
    for step in range(SORT_EVERY + 2):
        ids, places = (np.concatenate([found[step][n] for found in ranks]) for n in range(2))
        assert dict(zip(ids.tolist(), places.tolist(), strict=True)) == expected


def one_process(name: str):
    """Return the particles of one process after the steps of the program."""
    given = identified(name)
    simulation = simulators()[given.scene.simulator].create(given, device="cpu", folder=Path())
    advance(simulation, STEPS)
    return gathered(Ranks(RankInTurn(0, 1)), simulation)


def test_ids_last_on_ranks_and_through_a_resume_on_others(mpi, tmp_path):
    environment = {"PYTHONPATH": f"{TESTS}:{TESTS.parent}:{Path(__file__).parent}"}
    mpi(2, PROGRAM, "run", tmp_path, environment=environment)
    mpi(3, PROGRAM, "run,resume", tmp_path, environment=environment)
    for name in CASES:
        expected = one_process(name)
        for ranks in (2, 3):
            found = np.load(tmp_path / f"{name}_{ranks}.npz")
            if name in ROUNDED:
                assert len(found["id"]) == pytest.approx(len(expected.points), rel=0.02)
                continue
            np.testing.assert_array_equal(found["id"], expected.fields["id"])
            np.testing.assert_array_equal(found["age"], expected.fields["age"])
            np.testing.assert_allclose(found["points"], expected.points, atol=1e-4)
