"""Signs of the pressure problem on liquids with known results."""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import OPEN, VoxelSolids
from warp_lcp.material.boundary import WholeCells
from warp_lcp.material.boundary_kernels import HELD, RELEASED, TOUCHES_NOTHING

NX, NY = 6, 7


class TiltedTank:
    """Tank in 2-D with liquid in given cells; column i = 0 can be a piston (solid 1)."""

    def __init__(
        self,
        liquid: np.ndarray,
        *,
        separating: bool | tuple[bool, bool] = True,
        piston: float | None = None,
        tolerance: float = 1e-8,
    ) -> None:
        self.grid = StaggeredGrid((NX, NY, 1), 0.1, 2, "cpu")
        index = np.zeros(self.grid.shape, np.int32)
        index[1:-1, 1:-1, 1:-1] = OPEN
        velocity = None
        if piston is not None:
            index[1, 1:-1, 1] = 1
            velocity = np.array([[0.0, 0.0, 0.0], [piston, 0.0, 0.0]])
        flags = wp.array(np.broadcast_to(separating, 2).astype(np.uint8), device="cpu")
        names = ("domain", "solid[0] (box)")
        solids = VoxelSolids(
            index=wp.array(index, device="cpu"),
            separating=flags,
            names=names,
            covered=(0,),
            notes=(),
        )
        self.boundary = WholeCells(self.grid, solids, velocity, open_sides=0)
        self.projection = PressureProjection(
            self.grid, self.boundary, wl.MinimumMapNewton(), tolerance=tolerance, max_iterations=50
        )
        stored = np.zeros(self.grid.shape, bool)
        stored[1, 1:-1, 1:-1] = liquid
        kind = self.boundary.base.numpy()
        kind[stored & (kind == wl.AIR)] = wl.FLUID
        self.projection.kind.assign(kind)
        self.velocity = self.grid.faces()

    def project(self, dt: float = 0.01):
        self.projection.prepare(self.velocity, dt, dt)
        result, criteria = self.projection.solve(1.0)
        self.solved = result
        return self.projection.project(self.velocity, self.grid.everywhere, result, criteria)

    @property
    def x(self) -> np.ndarray:
        return self.projection.pressure.numpy()[1, 1:-1, 1:-1]

    @property
    def contact(self) -> np.ndarray:
        return self.projection.contact.numpy()[1, 1:-1, 1:-1]


def liquid(rows: slice, columns: slice = slice(None)) -> np.ndarray:
    cells = np.zeros((NY, NX), bool)
    cells[rows, columns] = True
    return cells


@pytest.mark.parametrize("separating", [True, False])
def test_a_pool_that_falls_onto_the_floor_is_stopped_by_a_positive_pressure(
    separating: bool,
) -> None:
    """Positive pressure that stops a falling pool: the sign of b.

    With the wrong sign x is negative with free-slip walls, zero with separating ones.
    """
    tank = TiltedTank(liquid(slice(0, 4)), separating=separating)
    tank.velocity[1].fill_(-0.5)
    projected = tank.project()
    depth = np.array([4, 3, 2, 1, 0, 0, 0])
    assert tank.x == pytest.approx(np.tile(0.5 * depth[:, None], (1, NX)), abs=1e-6)
    open_faces = tank.velocity[1].numpy()[1, 2:6, 1:-1]
    assert open_faces == pytest.approx(0.0, abs=1e-6)
    assert projected.released == 0
    assert projected.max_outflow < 1e-5
    assert projected.unknowns == 4 * NX


def test_a_block_leaves_the_ceiling_only_where_walls_separate() -> None:
    block = liquid(slice(4, 7))
    free, stuck = TiltedTank(block), TiltedTank(block, separating=False)
    for tank in (free, stuck):
        tank.velocity[1].fill_(-0.5)
    left, held = free.project(), stuck.project()
    assert (free.x == 0.0).all()
    assert left.released == NX
    assert (free.contact[6] == RELEASED).all()
    assert (free.contact[4:6, 1:-1] == TOUCHES_NOTHING).all()
    assert free.velocity[1].numpy()[1, 5:8, 1:-1] == pytest.approx(-0.5)
    assert held.released == 0
    assert stuck.x[4:, 2] == pytest.approx([-0.5, -1.0, -1.5], abs=1e-6)
    assert (stuck.contact[6] == HELD).all()


def test_the_walls_of_a_block_in_the_air_do_not_matter() -> None:
    tank = TiltedTank(liquid(slice(2, 5), slice(2, 4)))
    tank.velocity[1].fill_(-0.5)
    tank.velocity[0].fill_(0.25)
    projected = tank.project()
    assert tank.x == pytest.approx(0.0, abs=1e-12)
    assert (tank.contact == TOUCHES_NOTHING).all()
    assert projected.max_outflow == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("separating", [True, False])
def test_a_piston_pushes_as_much_liquid_out_of_the_surface_as_it_sweeps(separating: bool) -> None:
    tank = TiltedTank(liquid(slice(0, 4), slice(1, None)), separating=separating, piston=0.3)
    projected = tank.project()
    surface = tank.velocity[1].numpy()[1, 5, 2:-1]
    assert surface.sum() == pytest.approx(4 * 0.3, abs=1e-5)
    assert (surface > 0.0).all()
    assert tank.x[:4, 1].min() > 0.0
    assert projected.released == 0
    assert projected.max_outflow < 1e-5


def test_liquid_separates_from_a_retracting_piston_unless_it_is_free_slip() -> None:
    pool = liquid(slice(0, 4), slice(1, None))
    free, stuck = (
        TiltedTank(pool, separating=separating, piston=-0.3) for separating in (True, False)
    )
    left, held = free.project(), stuck.project()
    assert left.released == 4
    assert (free.x == 0.0).all()
    assert (free.contact[:4, 1] == RELEASED).all()
    assert held.released == 0
    assert stuck.x[:4, 1].max() < 0.0
    assert stuck.velocity[1].numpy()[1, 5, 2:-1].sum() == pytest.approx(-4 * 0.3, abs=1e-5)


def test_a_cell_under_pressure_is_held_whatever_flows_out_of_it() -> None:
    tank = TiltedTank(liquid(slice(0, 4)))
    tank.velocity[1].fill_(-0.5)
    tank.projection.prepare(tank.velocity, 0.01, 0.01)
    result, criteria = tank.projection.solve(1.0)
    tank.velocity[1].fill_(0.5)
    assert (
        tank.projection.project(tank.velocity, tank.grid.everywhere, result, criteria).released == 0
    )
    assert (tank.contact[0] == HELD).all()


def test_a_full_box_with_a_retracting_piston_needs_a_separating_wall() -> None:
    full = liquid(slice(None), slice(1, None))
    free, stuck = (
        TiltedTank(full, separating=separating, piston=-0.3) for separating in (True, False)
    )
    stuck.projection.prepare(stuck.velocity, 0.01, 0.01)
    assert stuck.projection.solve(1.0)[0].status is wl.SolveStatus.INFEASIBLE
    assert free.project().released > 0
    assert free.solved.status is wl.SolveStatus.CONVERGED


def test_a_wall_cell_is_judged_by_each_of_its_walls() -> None:
    """Bound of a corner cell with a separating piston beside a free-slip floor."""
    cell = liquid(slice(0, 1), slice(1, 2))
    tank = TiltedTank(cell, separating=(False, True), piston=-0.3)
    assert tank.project().released == 1
    tank = TiltedTank(cell, separating=False, piston=-0.3)
    assert tank.project().released == 0
    assert tank.x[0, 1] == pytest.approx(-0.15, abs=1e-6)


def test_the_last_pressure_starts_the_next_solve_whatever_the_time_step() -> None:
    tank = TiltedTank(liquid(slice(0, 4)), tolerance=1e-6)
    for dt in (0.01, 0.02, 0.005):
        tank.velocity[1].fill_(-50.0 * dt)
        tank.project(dt)
        pressure = tank.projection.pressures(1000.0)[1, 1, 1]
        assert pressure == pytest.approx(1000.0 * 50.0 * 0.1 * 4, rel=1e-5)
        assert tank.solved.iterations == 0 or dt == 0.01


def test_a_solve_leaves_velocity_and_pressure_alone() -> None:
    tank = TiltedTank(liquid(slice(0, 4)))
    tank.velocity[1].fill_(-0.5)
    tank.project()
    pressure, velocity = tank.projection.pressure.numpy().copy(), tank.velocity[1].numpy().copy()
    tank.velocity[0].fill_(0.125)
    tank.projection.prepare(tank.velocity, 0.02, 0.02)
    tank.projection.solve(1.0)
    assert (tank.projection.pressure.numpy() == pressure).all()
    assert (tank.velocity[1].numpy() == velocity).all()


def test_noise_of_a_uniform_fall_is_not_iterated_on() -> None:
    tank = TiltedTank(liquid(slice(2, 5), slice(2, 4)))
    rng = np.random.default_rng(12)
    tank.velocity[1].assign(
        (-3.0 * (1 + 6e-8 * rng.normal(size=tank.grid.shape))).astype(np.float32)
    )
    tank.projection.prepare(tank.velocity, 0.01, 0.01)
    result, _ = tank.projection.solve(3.0)
    assert result.status is wl.SolveStatus.CONVERGED
    assert result.iterations == 0


def test_wall_velocities_of_another_number_of_walls_are_refused() -> None:
    tank = TiltedTank(liquid(slice(0, 4)))
    with pytest.raises(ValueError, match="wall_velocity"):
        WholeCells(tank.grid, tank.boundary.solids, np.zeros((3, 3)), open_sides=0)
