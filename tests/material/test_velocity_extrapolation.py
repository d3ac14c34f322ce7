import numpy as np
import pytest
import warp as wp

from warp_lcp import AIR, FLUID, SOLID
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary_kernels import HELD, RELEASED
from warp_lcp.material.velocity_extrapolation import SprayViscosity, extend_velocity

GRID = StaggeredGrid((5, 6, 1), 0.1, 2, "cpu")
CEILING = GRID.counts[1] + 1  # row of the ceiling's faces


class AirAndFluidBox:
    """Box in 2-D of AIR and FLUID cells.

    Every open face that touches FLUID has been projected to one velocity.
    """

    def __init__(self, fluid: np.ndarray, velocity: tuple[float, float]) -> None:
        kind = np.full(GRID.shape, SOLID, np.int8)
        kind[1, 1:-1, 1:-1] = np.where(fluid, FLUID, AIR)
        index = np.where(kind == SOLID, 0, -1).astype(np.int32)
        self.kind, self.index = wp.array(kind, device="cpu"), wp.array(index, device="cpu")
        self.contact = GRID.field(wp.uint8)
        self.separating = wp.array([1], dtype=wp.uint8, device="cpu")
        self.velocity, self.weights, self.known = GRID.faces(), GRID.faces(), GRID.faces(wp.int8)
        for axis in range(2):
            below = np.roll(kind, 1, 2 - axis)
            projected = (kind != SOLID) & (below != SOLID) & ((kind == FLUID) | (below == FLUID))
            marks = np.where((kind == SOLID) & (below == SOLID), -1, projected).astype(np.int8)
            self.known[axis].assign(marks)
            self.velocity[axis].assign((projected * velocity[axis]).astype(np.float32))

    def extend(
        self,
        layers: int = 4,
        wall_velocity: float | None = None,
        spray: SprayViscosity | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        solid = GRID.faces() if wall_velocity is not None else []
        for field in solid[1:]:
            field.fill_(wall_velocity)
        extend_velocity(
            GRID.everywhere,
            self.velocity,
            self.weights,
            self.known,
            self.kind,
            self.contact,
            self.index,
            self.separating,
            solid,
            layers,
            spray=spray,
        )
        u, v = (field.numpy()[1] for field in self.velocity)
        return u, v


def cells(*at: tuple[int, int]) -> np.ndarray:
    """Return FLUID at (x, y), counted from 0."""
    fluid = np.zeros((6, 5), bool)
    for x, y in at:
        fluid[y, x] = True
    return fluid


TOP = [(x, y) for x in range(5) for y in (4, 5)]


@pytest.mark.parametrize(
    ("separating", "state", "speed", "expected"),
    [
        (1, HELD, -0.5, 0.0),
        (1, RELEASED, -0.5, -0.5),  # separates
        (1, RELEASED, 0.5, 0.0),  # but not into the wall
        (0, HELD, -0.5, 0.0),
        (0, RELEASED, -0.5, 0.0),  # a free-slip face of a cell that another wall released
    ],
)
def test_closed_faces_of_liquid_cells(
    separating: int, state: int, speed: float, expected: float
) -> None:
    air = AirAndFluidBox(cells(*TOP), (0.0, speed))
    air.separating.fill_(separating)
    air.contact.fill_(state)
    _, v = air.extend()
    assert v[CEILING, 1:-1] == pytest.approx(expected)
    assert v[CEILING - 1, 1:-1] == pytest.approx(speed)


@pytest.mark.parametrize("separating", [0, 1])
@pytest.mark.parametrize(("speed", "expected"), [(0.5, 0.5), (-0.5, 0.0)])
def test_closed_faces_of_air_lose_only_what_goes_into_the_wall(
    separating: int, speed: float, expected: float
) -> None:
    air = AirAndFluidBox(cells((2, 2), (2, 3)), (0.0, speed))
    air.separating.fill_(separating)
    _, v = air.extend()
    assert v[1, 3] == pytest.approx(expected)


def test_a_held_cell_follows_a_moving_wall_both_ways() -> None:
    for wall in (0.25, -0.25):
        air = AirAndFluidBox(cells(*TOP), (0.0, 0.1))
        air.contact.fill_(HELD)
        _, v = air.extend(wall_velocity=wall)
        assert v[CEILING, 1:-1] == pytest.approx(wall)


def test_a_released_cell_is_pushed_by_a_wall_that_overtakes_it() -> None:
    air = AirAndFluidBox(cells(*TOP), (0.0, -0.1))
    air.contact.fill_(RELEASED)
    _, v = air.extend(wall_velocity=-0.25)
    assert v[CEILING, 1:-1] == pytest.approx(-0.25)


@pytest.mark.parametrize(
    ("separating", "state", "weight", "own_speed", "expected"),
    [
        (1, RELEASED, 4.6, 0.06, 0.06),  # not the speed of the leaving liquid
        (1, RELEASED, 4.6, -0.06, 0.0),  # but not into the wall
        (1, RELEASED, 0.0, 0.0, 3.0),  # no velocity of its own
        (1, HELD, 4.6, 0.06, 0.0),
        (0, RELEASED, 4.6, 0.06, 0.0),
    ],
)
def test_liquid_at_rest_at_a_wall_does_not_follow_liquid_that_leaves(
    separating: int, state: int, weight: float, own_speed: float, expected: float
) -> None:
    air = AirAndFluidBox(cells((0, 0)), (3.0, 0.0))
    air.separating.fill_(separating)
    air.contact.fill_(state)
    air.velocity[0][1, 1, 1:2].fill_(own_speed)
    air.weights[0][1, 1, 1:2].fill_(weight)
    u, _ = air.extend()
    assert u[1, 2] == 3.0
    assert u[1, 1] == pytest.approx(expected)
    assert u[1, 3] == 3.0  # the first layer is the projected face's
    assert u[0, 1] == pytest.approx(u[1, 1])  # inside the corner it follows


def test_liquid_that_leaves_a_wall_stops_before_liquid_that_flows_to_it() -> None:
    """Velocity of a closed face against the mean of the faces around it: 0.

    The product of both speeds is -0.06 m^2/s^2. A particle at the wall moves away from it, the
    liquid beside it toward the wall; the face must not move against the liquid.
    """
    air = AirAndFluidBox(cells((0, 0)), (-1.0, 0.0))
    air.contact.fill_(RELEASED)
    air.velocity[0][1, 1, 1:2].fill_(0.06)
    air.weights[0][1, 1, 1:2].fill_(4.6)
    u, _ = air.extend()
    assert u[1, 2] == -1.0
    assert u[1, 1] == 0.0


def test_spray_beyond_one_layer_keeps_its_own_velocity() -> None:
    """Velocity of spray beyond one layer: its own.

    A drop above a pool at rest: extrapolating the pool over it would make it hang.
    """
    air = AirAndFluidBox(cells(*((x, 0) for x in range(5))), (0.0, 0.0))
    for row in (3, 5):
        air.velocity[1][1, row, 3:4].fill_(-2.0)
        air.weights[1][1, row, 3:4].fill_(1.0)
    _, v = air.extend()
    assert v[2, 3] == 0.0
    assert v[3, 3] == 0.0  # the first layer above the pool's own faces
    assert v[5, 3] == -2.0
    assert v[6, 3] == -2.0  # the rest is extrapolated from both


def test_spray_above_each_other_in_3d_keeps_its_own_velocity() -> None:
    """The same in 3-D, with z upwards, in a window of some planes.

    See `test_spray_beyond_one_layer_keeps_its_own_velocity`.
    """
    grid = StaggeredGrid((5, 5, 12), 0.1, 3, "cpu")
    kind = np.full(grid.shape, SOLID, np.int8)
    kind[1:-1, 1:-1, 1:-1] = AIR
    kind[1, 1:-1, 1:-1] = FLUID
    velocity, weights, known = grid.faces(), grid.faces(), grid.faces(wp.int8)
    for axis in range(3):
        below = np.roll(kind, 1, 2 - axis)
        projected = (kind != SOLID) & (below != SOLID) & ((kind == FLUID) | (below == FLUID))
        known[axis].assign(
            np.where((kind == SOLID) & (below == SOLID), -1, projected).astype(np.int8)
        )
    drops = range(4, 12)
    for plane in drops:
        velocity[2][plane, 3, 3:4].fill_(-plane)
        weights[2][plane, 3, 3:4].fill_(1.0)
    index = wp.array(np.where(kind == SOLID, 0, -1).astype(np.int32), device="cpu")
    walls = [
        wp.array(kind, device="cpu"),
        grid.field(wp.uint8),
        index,
        wp.array([1], dtype=wp.uint8, device="cpu"),
    ]
    extend_velocity(
        Window((3, 0, 0), grid.shape, grid.everywhere.device),
        velocity,
        weights,
        known,
        *walls,
        [],
        12,
    )
    assert [velocity[2].numpy()[plane, 3, 3] for plane in drops] == [-plane for plane in drops]


def test_a_closed_face_is_no_source_of_spray() -> None:
    air = AirAndFluidBox(cells(*((x, 0) for x in range(5))), (0.0, 0.0))
    air.velocity[0][1, 6, 1:2].fill_(3.0)
    air.weights[0][1, 6, 1:2].fill_(1.0)
    u, _ = air.extend()
    assert u[6, 1] == 3.0  # AIR that leaves the wall
    assert u[6, 2] == 0.0


def test_tangential_flow_continues_into_the_wall() -> None:
    air = AirAndFluidBox(cells(*((x, y) for x in range(5) for y in range(2))), (0.75, 0.0))
    u, v = air.extend()
    assert u[0, 2:-1] == pytest.approx(0.75)  # inside the floor
    assert u[1, 1] == pytest.approx(0.0)  # held by the left wall
    assert u[0, 1] == pytest.approx(0.0)  # the corner follows it
    assert v[1, 0] == pytest.approx(0.0)


def test_layers_end() -> None:
    air = AirAndFluidBox(cells(*((x, 0) for x in range(5))), (0.5, 0.0))
    u, _ = air.extend(layers=2)
    assert u[4, 3] == pytest.approx(0.5)
    assert u[5, 3] == 0.0


@pytest.mark.parametrize("tau", [0.0, 0.5, 1e4])
def test_viscous_stress_acts_on_spray_that_moves_away_from_liquid(tau: float) -> None:
    # v of the face two below the liquid, whose links are those to the face above and, once it is
    # known, none beside: (own + tau above) / (1 + tau).
    box = AirAndFluidBox(cells(*TOP), (0.0, 1.0))
    own, row = -3.0, 3
    box.velocity[1].numpy()[1, row, 3] = own
    box.weights[1].numpy()[1, row, 3] = 1.0
    _, v = box.extend(spray=SprayViscosity(Scalar(tau)))
    assert v[row, 3] == pytest.approx((own + tau * 1.0) / (1.0 + tau), rel=1e-6)


def test_spray_that_approaches_liquid_keeps_its_velocity() -> None:
    box = AirAndFluidBox(cells(*TOP), (0.0, 1.0))
    box.velocity[1].numpy()[1, 3, 3] = 2.5
    box.weights[1].numpy()[1, 3, 3] = 1.0
    _, v = box.extend(spray=SprayViscosity(Scalar(1e4)))
    assert v[3, 3] == np.float32(2.5)


def test_spray_of_thin_liquid_has_less_stress() -> None:
    speeds = []
    for relative in (1.0, 1e-3):
        box = AirAndFluidBox(cells(*TOP), (0.0, 1.0))
        box.velocity[1].numpy()[1, 3, 3] = -3.0
        box.weights[1].numpy()[1, 3, 3] = 1.0
        field = GRID.field()
        field.fill_(relative)
        speeds.append(box.extend(spray=SprayViscosity(Scalar(10.0), field))[1][3, 3])
    assert speeds == pytest.approx([7.0 / 11.0, (-3.0 + 0.01) / 1.01], rel=1e-5)
