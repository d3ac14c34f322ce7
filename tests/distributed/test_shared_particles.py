"""Migration of particles between ranks, without MPI.

The ranks take turns in one process.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ranks_in_turn import RankInTurn, on_ranks

from warp_lcp.distributed.decomposition import Decomposition
from warp_lcp.distributed.particles import REACH
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.particles import SORT_EVERY, Particles
from warp_lcp.grid.staggered import StaggeredGrid

LAYERS = 5
SPACING = 0.03


def part_of(
    seat: RankInTurn, counts: tuple[int, int, int], periodic: tuple[int, ...] = ()
) -> Subdomain:
    """Return a rank's part of a grid."""
    dimension, boxes = (
        2 if counts[2] == 1 else 3,
        Decomposition(counts, Ranks(seat), periodic=periodic),
    )
    return Subdomain(
        boxes, spacing=SPACING, dimension=dimension, device="cpu", layers=LAYERS, mailbox=seat
    )


def cells_of(position: np.ndarray) -> np.ndarray:
    """Return the cells of positions that lie well inside them."""
    return np.floor(position / SPACING).astype(int)


def scattered(counts: tuple[int, int, int], n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions in the middle parts of cells, and velocities."""
    rng = np.random.default_rng(2718)
    axes = 2 if counts[2] == 1 else 3
    position = np.zeros((n, 3))
    for axis in range(axes):
        position[:, axis] = (
            rng.integers(counts[axis], size=n) + rng.uniform(0.05, 0.95, n)
        ) * SPACING
    return position.astype(np.float32), rng.normal(size=(n, 3)).astype(np.float32)


def moved(position: np.ndarray, counts: tuple[int, int, int], step: int) -> np.ndarray:
    """Return positions up to two cells away, in the domain.

    They depend on the old position alone.
    """
    axes = 2 if counts[2] == 1 else 3
    hashed = np.abs(np.sin(position[:, :axes].astype(np.float64) * 9137.0 + step))
    way = np.floor(hashed * 5.0).astype(int) - 2
    cell = np.clip(cells_of(position)[:, :axes] + way, 0, np.array(counts[:axes]) - 1)
    result = position.copy()
    result[:, :axes] = (cell + 0.05 + 0.9 * np.abs(np.cos(hashed * 77.0))) * SPACING
    return result


def in_order(particles: Particles) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities in the order of deterministic sums."""
    order = np.argsort(particles.exchange.place)
    return particles.position.numpy()[order], particles.velocity.numpy()[order]


CASES = [((24, 12, 1), 2), ((24, 20, 1), 4), ((12, 10, 11), 4), ((12, 12, 12), 8)]


@pytest.mark.parametrize(("counts", "size"), CASES)
def test_particles_go_to_the_rank_of_their_cell_in_the_order_of_one_process(counts, size):
    position, velocity = scattered(counts, 900)
    steps = SORT_EVERY + 3
    grid = StaggeredGrid(counts, SPACING, 2 if counts[2] == 1 else 3, "cpu")
    alone, orders = Particles(grid, position, velocity, affine=True), []
    alone.sort()
    for step in range(steps):
        alone.arrange(step)
        orders.append((alone.position.numpy().copy(), alone.velocity.numpy().copy()))
        alone.position.assign(moved(alone.position.numpy(), counts, step))

    def work(seat: RankInTurn) -> list[tuple[np.ndarray, np.ndarray]]:
        part = part_of(seat, counts)
        mine = part.owners(cells_of(position)) == seat.rank
        particles = Particles(part.grid, position[mine], velocity[mine], affine=True)
        particles.sort()
        rows = []
        for step in range(steps):
            particles.arrange(step)
            with_ghosts = in_order(particles)
            if particles.runs is not None:
                order = [np.arange(*run) for run in particles.runs.numpy().reshape(-1, 2)]
                assert (np.diff(particles.exchange.place[np.concatenate(order)]) > 0).all()
            particles.drop_ghosts()
            rows.append((*with_ghosts, *in_order(particles)))
            particles.position.assign(moved(particles.position.numpy(), counts, step))
        return rows

    found = on_ranks(size, work)
    boxes = Decomposition(counts, Ranks(RankInTurn(0, size))).boxes
    for step, (where, how) in enumerate(orders):
        cells = cells_of(where)
        for rank, box in enumerate(boxes):
            own = ((cells >= box.low) & (cells < box.high)).all(axis=1)
            near = (
                (cells >= np.array(box.low) - REACH) & (cells < np.array(box.high) + REACH)
            ).all(axis=1)
            expected = where[near], how[near], where[own], how[own]
            for array, wanted in zip(found[rank][step], expected, strict=True):
                np.testing.assert_array_equal(array, wanted)


DENSITY = """
    import numpy as np
    from test_shared_particles import LAYERS, SPACING, cells_of, scattered
    from warp_lcp.distributed.decomposition import Decomposition
    from warp_lcp.distributed.ranks import Ranks
    from warp_lcp.distributed.subdomain import Subdomain
    from warp_lcp.grid.level_set import particle_density
    from warp_lcp.grid.particles import Particles
    from warp_lcp.grid.staggered import StaggeredGrid
    from warp_lcp.material.density_correction import density_of_all

    counts, full = (24, 12, 1), 4  # particles in a full cell
    position, velocity = scattered(counts, 900)
    grid = StaggeredGrid(counts, SPACING, 2, "cpu")
    alone, expected = Particles(grid, position, velocity, affine=False), grid.field()
    alone.sort()
    particle_density(grid, alone, grid.everywhere, full, expected)

    ranks = Ranks.world()
    part = Subdomain(
        Decomposition(counts, ranks), spacing=SPACING, dimension=2, device="cpu", layers=LAYERS
    )
    mine = part.owners(cells_of(position)) == ranks.rank
    particles = Particles(part.grid, position[mine], velocity[mine], affine=False)
    density, x = part.grid.field(), part.grid.origin[0]
    particles.sort()
    density_of_all(part.grid, None, particles, part.grid.everywhere, full, density)
    ours, whole = density.numpy()[1, 1:-1, 1:-1], expected.numpy()[1, 1:-1, 1:-1]
    assert ours.shape[1] > whole.shape[1] // 2
    np.testing.assert_allclose(ours, whole[:, x : x + ours.shape[1]], atol=1e-6)
    print(f"alike{ranks.rank} ", end="")
"""


def test_densities_of_ranks_are_those_of_one_process_also_in_ghost_cells(mpi):
    """Density in all cells that a rank of two has, those of the other rank included."""
    tests = Path(__file__).parent
    done = mpi(2, DENSITY, environment={"PYTHONPATH": f"{tests}:{tests.parent}:{tests.parents[1]}"})
    assert sorted(done.stdout.split()) == ["alike0", "alike1"]


@pytest.mark.parametrize(
    ("counts", "size", "periodic"),
    [((24, 12, 1), 2, (0,)), ((13, 12, 14), 4, (0, 2)), ((13, 12, 14), 8, (0,))],
)
def test_particles_go_around(counts, size, periodic):
    """Ghost particles: everything near a box, also through periodic sides.

    Each appears once, where it continues the box.
    """
    position, velocity = scattered(counts, 900)
    position[:4, 0] = 0.0, 1e-9, (counts[0] - 1e-3) * SPACING, SPACING
    domain = np.array(
        [n * SPACING if axis in periodic else np.inf for axis, n in enumerate(counts)]
    )

    def work(seat: RankInTurn) -> None:
        part = part_of(seat, counts, periodic)
        low, high = ((np.array(corner) - 0.5) * SPACING for corner in (part.box.low, part.box.high))
        mine = part.owners(cells_of(position)) == seat.rank
        particles = Particles(part.grid, position[mine], velocity[mine], affine=True)
        particles.sort()
        for step in range(SORT_EVERY + 3):
            all_positions = np.concatenate(seat.allgather(particles.position.numpy().astype(float)))
            assert len(all_positions) == len(position)
            particles.arrange(step)
            found = particles.position.numpy().astype(float)
            assert len(np.unique(particles.exchange.place)) == len(found)
            images = [
                x + np.array(shift) * SPACING
                for shift in part.decomposition.shifts
                for x in all_positions
            ]
            near = np.array([x for x in images if within(x, low, high)])
            seen = found[within(found, low, high)]
            assert len(seen) == len(near)
            np.testing.assert_allclose(np.sort(seen[:, 1]), np.sort(near[:, 1]))
            particles.drop_ghosts()
            moves = particles.position.numpy() + np.float32(2.7 * SPACING) * np.sin(
                9137.0 * particles.velocity.numpy() + step
            )
            inside = np.clip(moves, 0.01 * SPACING, (np.array(counts) - 0.01) * SPACING) * (
                np.array(counts) > 1
            )
            particles.position.assign(
                np.where(np.isfinite(domain), np.mod(moves, domain), inside).astype(np.float32)
            )

    on_ranks(size, work)


def within(x, low, high):
    """Return which points lie in a box; in 2-D points have no z."""
    return ((x >= low) & (x < high))[..., :2].all(axis=-1) & (
        (x[..., 2] == 0.0) | ((x[..., 2] >= low[2]) & (x[..., 2] < high[2]))
    )


def test_gradients_travel_with_their_particles():
    counts = (24, 20, 1)
    position, velocity = scattered(counts, 300)

    def work(seat: RankInTurn) -> bool:
        part = part_of(seat, counts)
        mine = part.owners(cells_of(position)) == seat.rank
        particles = Particles(part.grid, position[mine], velocity[mine], affine=True)
        particles.sort()
        for step in range(3):
            for n, gradient in enumerate(particles.affine):
                gradient.assign((n + 1) * particles.velocity.numpy())
            particles.arrange(step)
            for n, gradient in enumerate(particles.affine):
                np.testing.assert_array_equal(
                    gradient.numpy(), (n + 1) * particles.velocity.numpy()
                )
            particles.drop_ghosts()
            particles.position.assign(moved(particles.position.numpy(), counts, step))
        return True

    assert all(on_ranks(4, work))


def test_sums_are_of_all_ranks_and_count_each_particle_once():
    counts = (12, 12, 12)
    position, velocity = scattered(counts, 500)
    alone = Particles(
        StaggeredGrid(counts, SPACING, 3, "cpu"), position, velocity, affine=False
    ).totals()

    def work(seat: RankInTurn) -> Any:
        part = part_of(seat, counts)
        mine = (
            (part.owners(cells_of(position)) == seat.rank)
            if seat.rank
            else np.zeros(len(position), dtype=bool)
        )
        if seat.rank == 1:  # that of rank 0 has not migrated yet
            mine |= part.owners(cells_of(position)) == 0
        particles = Particles(part.grid, position[mine], velocity[mine], affine=False)
        return particles.totals()

    for totals in on_ranks(8, work):
        assert (totals.count, totals.bad_positions, totals.bad_velocities) == (500, 0, 0)
        # Squares in float32, rounded in blocks.
        assert totals.mean_square_speed == pytest.approx(alone.mean_square_speed, rel=1e-8)
        np.testing.assert_allclose(totals.center, alone.center, rtol=1e-13)
        np.testing.assert_array_equal([totals.low, totals.high], [alone.low, alone.high])
        assert totals.max_speed == alone.max_speed


def test_particles_that_are_not_finite_are_counted_on_all_ranks():
    counts = (24, 12, 1)
    position, velocity = scattered(counts, 40)
    velocity[7, 1], position[9, 0] = np.nan, np.inf

    def work(seat: RankInTurn) -> Any:
        part = part_of(seat, counts)
        half = slice(0, 20) if seat.rank == 0 else slice(20, 40)
        return Particles(part.grid, position[half], velocity[half], affine=False).totals()

    for totals in on_ranks(2, work):
        assert (totals.count, totals.bad_positions, totals.bad_velocities, totals.finite) == (
            40,
            1,
            1,
            False,
        )


def test_a_rank_may_have_no_particle():
    counts = (24, 12, 1)
    position = np.array([[0.4 * SPACING, 0.5 * SPACING, 0.0]], dtype=np.float32)

    def work(seat: RankInTurn) -> int:
        part = part_of(seat, counts)
        n = 1 - seat.rank
        particles = Particles(
            part.grid, position[:n], np.ones((n, 3), dtype=np.float32), affine=True
        )
        particles.sort()
        for step in range(2):
            particles.arrange(step)
            particles.drop_ghosts()
        assert particles.totals().count == 1
        return particles.count

    assert on_ranks(2, work) == [1, 0]


def test_boxes_thinner_than_the_ghost_layers_are_refused():
    def work(seat: RankInTurn) -> None:
        part_of(seat, (16, 3, 1))

    with pytest.raises(
        ValueError,
        match=r"4 ranks along x have boxes of 4 cells.*needs 5 layers around a box: start fewer "
        r"ranks \(at most 3 along that axis\)",
    ):
        on_ranks(4, work)


def test_a_part_has_the_cells_around_its_box_and_ends_where_the_domain_does():
    def work(seat: RankInTurn) -> tuple[Any, ...]:
        part = part_of(seat, (24, 12, 1))
        return part.grid.counts, part.grid.origin, part.cuts, part.owned.low, part.owned.high

    assert on_ranks(2, work) == [
        ((16, 12, 1), (0, 0, 0), 0b10, (1, 1, 1), (2, 13, 13)),
        ((16, 12, 1), (8, 0, 0), 0b01, (1, 1, 5), (2, 13, 17)),
    ]
