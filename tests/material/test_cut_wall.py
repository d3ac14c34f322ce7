from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_lcp import AIR, FLUID, SOLID
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.boundary_kernels import HELD, RELEASED, TOUCHES_NOTHING
from warp_lcp.material.velocity_extrapolation import extend_velocity, extend_velocity_cut

FLAT = StaggeredGrid((24, 22, 1), 0.1, 2)
SPACE = StaggeredGrid((12, 13, 11), 0.1, 3)
Faces = Sequence[np.ndarray]  # one field for each component
JUNK = 1e3  # on faces that are neither projected nor have weight


def points(grid: StaggeredGrid, offset: Sequence[float]) -> np.ndarray:
    """Return the points (x, y, z) at an offset from the cells' low corners.

    They are in cells from the domain's corner.
    """
    k, j, i = np.meshgrid(*(np.arange(n) - 1.0 for n in grid.shape), indexing="ij")
    return np.stack(
        [i + offset[0], j + offset[1], (k + offset[2]) * (grid.dimension == 3)], axis=-1
    )


def face_centers(grid: StaggeredGrid, axis: int) -> np.ndarray:
    return points(grid, [0.0 if d == axis else 0.5 for d in range(3)])


class SlopedWall:
    """Liquid or air over a plane.

    By default every open face has been projected to one velocity.

    Args:
        grid: the grid.
        normal: normal of the plane, into the open.
        kind: kind of the open cells.
        contact: contact state of the open cells that the plane cuts.
        shift: distance of the plane from the domain's center along its normal [cells].
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        normal: tuple[float, float, float],
        kind: int = FLUID,
        contact: int = HELD,
        shift: float = 0.0,
    ) -> None:
        self.grid, self.normal = grid, np.array(normal) / np.linalg.norm(normal)
        self.at = 0.5 * np.array(grid.counts) * [1, 1, grid.dimension == 3] + shift * self.normal
        nodes = self.signed(points(grid, (0, 0, 0)))
        sides = [
            np.minimum(c, n - c)
            for c, n in zip(np.moveaxis(points(grid, (0, 0, 0)), -1, 0), grid.counts, strict=False)
        ]
        distance = np.minimum(nodes, np.min(sides[: grid.dimension], axis=0))
        ring = np.ones(grid.shape, bool)
        ring[1:-1, 1:-1, 1:-1] = False
        self.open: list[np.ndarray] = []
        self.wall: list[np.ndarray] = []
        for axis in range(grid.dimension):
            fraction = self.fraction(axis)
            outside = ring.copy()
            outside[(slice(1, -1),) * (2 - axis) + (1,)] = True  # the domain's lower wall
            fraction[outside] = 0.0
            self.open.append(fraction)
            # The plane must be the nearest wall.
            inner = self.signed(face_centers(grid, axis)) < 0.5
            self.wall.append(
                np.where(fraction == 1.0, -1, np.where(inner & ~outside, 1, 0)).astype(np.int16)
            )
        cells = np.full(grid.shape, SOLID, np.int8)
        touches = np.full(grid.shape, TOUCHES_NOTHING, np.uint8)
        for axis, fraction in enumerate(self.open):
            upper = np.roll(fraction, -1, 2 - axis)
            cells[((fraction > 0) | (upper > 0)) & ~ring] = kind
            touches[((fraction < 1) | (upper < 1)) & ~ring] = contact
        touches[cells != FLUID] = TOUCHES_NOTHING
        self.kind, self.contact = cells, touches
        self.distance = distance
        self.separating = [1, 1]
        self.moving: list[np.ndarray] | None = None
        self.speed = np.zeros(3)

    def move(self, velocity: np.ndarray) -> None:
        """Set the velocity of the plane [m/s]."""
        self.speed = velocity
        # Open faces have no wall velocity.
        self.moving = [np.where(f < 1, velocity[axis], np.nan) for axis, f in enumerate(self.open)]

    def signed(self, x: np.ndarray) -> np.ndarray:
        return (x - self.at) @ self.normal

    def fraction(self, axis: int) -> np.ndarray:
        """Return the open fraction of each face by samples."""
        n = 16
        samples = (np.arange(n) + 0.5) / n
        total = np.zeros(self.grid.shape)
        other_axes = [d for d in range(self.grid.dimension) if d != axis]
        for b in samples:
            for c in samples if len(other_axes) == 2 else samples[:1]:
                offset = np.zeros(3)
                offset[other_axes] = [b, c][: len(other_axes)]
                total += self.signed(points(self.grid, offset)) > 0
        return (total / n ** len(other_axes)).astype(np.float32)

    def extend(
        self,
        velocity: tuple[float, ...],
        layers: int = 4,
        *,
        closed: tuple[float, ...] = (JUNK,) * 3,
        weights: Faces = (),
    ) -> list[np.ndarray]:
        grid = self.grid
        weight_arrays = [
            wp.array(w, dtype=wp.float32, device="cpu") for w in weights
        ] or grid.faces()
        fields, known = [], []
        for axis, fraction in enumerate(self.open):
            fields.append(
                wp.array(
                    np.where(fraction > 0, velocity[axis], closed[axis]).astype(np.float32),
                    device="cpu",
                )
            )
            is_open = fraction > 0
            if grid.dimension == 2:
                is_open[[0, 2]] = False
            known.append(wp.array(is_open.astype(np.int8), device="cpu"))
        extend_velocity_cut(
            grid.everywhere,
            fields,
            weight_arrays,
            known,
            wp.array(self.kind, device="cpu"),
            wp.array(self.contact, device="cpu"),
            self.cut(),
            grid.faces(),
            layers,
        )
        return [field.numpy() for field in fields]

    def cut(self) -> Any:
        moving = (
            None
            if self.moving is None
            else [
                wp.array(m.astype(np.float32), dtype=wp.float32, device="cpu") for m in self.moving
            ]
        )
        return SimpleNamespace(
            distance=wp.array(self.distance.astype(np.float32), dtype=wp.float32, device="cpu"),
            open=[wp.array(f, dtype=wp.float32, device="cpu") for f in self.open],
            wall=[wp.array(w, dtype=wp.int16, device="cpu") for w in self.wall],
            velocity=moving,
            nearest=[],
            grid=self.grid,
            turn=wp.zeros(2, dtype=wp.mat33, device="cpu"),
            shift=wp.array([np.zeros(3), self.speed], dtype=wp.vec3, device="cpu"),
            separating=wp.array(self.separating, dtype=wp.uint8, device="cpu"),
        )

    def judged(self, axis: int) -> np.ndarray:
        """Return the closed faces in reach of a particle's tent function.

        Faces near the domain's walls are left out.
        """
        x = face_centers(self.grid, axis)
        away = np.all(
            [
                (x[..., d] > 2.6) & (x[..., d] < self.grid.counts[d] - 2.6)
                for d in range(self.grid.dimension)
            ],
            axis=0,
        )
        if self.grid.dimension == 2:
            away[[0, 2]] = False
        return away & (self.open[axis] == 0) & (self.signed(x) > -1.5)


SLOPES = [
    (FLAT, (-0.5, 0.75**0.5, 0.0)),
    (FLAT, (0.0, 1.0, 0.0)),
    (FLAT, (0.7, -0.4, 0.0)),
    (FLAT, (1.0, 1.0, 0.0)),
    (SPACE, (-0.3, 0.8, 0.5)),
]
IDS = ["30 degrees", "flat", "ceiling", "along diagonals", "3d"]


def expected(slope: SlopedWall, velocity: tuple[float, ...], removes: bool) -> np.ndarray:
    u = np.array([*velocity, 0.0][:3])
    return u - (u @ slope.normal) * slope.normal * removes


@pytest.mark.default_cases(15)
@pytest.mark.parametrize(("grid", "normal"), SLOPES, ids=IDS)
@pytest.mark.parametrize("towards", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("kind", "contact", "separating", "holds"),
    [
        (FLUID, HELD, 1, True),
        (FLUID, RELEASED, 1, False),
        (FLUID, RELEASED, 0, True),  # a free-slip face of a cell that another wall released
        (FLUID, HELD, 0, True),
        (AIR, TOUCHES_NOTHING, 1, False),
        (AIR, TOUCHES_NOTHING, 0, False),
    ],
)
def test_closed_faces_along_a_slope(
    grid: StaggeredGrid,
    normal: tuple[float, float, float],
    towards: float,
    kind: int,
    contact: int,
    separating: int,
    holds: bool,
) -> None:
    """Closed faces along a slope.

    Tangential flow stays whole. Outflow is held back only where the wall holds; inflow is stopped
    everywhere.
    """
    slope = SlopedWall(grid, normal, kind, contact)
    slope.separating[1] = separating
    tangent = np.array([slope.normal[1], -slope.normal[0], 0.0])
    velocity = tuple(0.8 * tangent + 0.3 * towards * slope.normal)[: grid.dimension]
    fields = slope.extend(velocity)
    wanted = expected(slope, velocity, holds or towards < 0)
    for axis, field in enumerate(fields):
        judged = slope.judged(axis)
        assert judged.sum() > 15
        assert np.abs(field[judged] - wanted[axis]).max() < 2e-6
        assert (field[slope.open[axis] > 0] == np.float32(velocity[axis])).all()


class RoundWall(SlopedWall):
    """Liquid around a disc of a radius [cells] about a point, which the domain's walls may cut."""

    def __init__(self, center: tuple[float, float, float], radius: float) -> None:
        self.center, self.radius = np.array(center), radius
        super().__init__(FLAT, (1.0, 0.0, 0.0))
        self.distance = self.signed(points(FLAT, (0, 0, 0)))

    def signed(self, x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x - self.center, axis=-1) - self.radius


@pytest.mark.parametrize("axis", [0, 1])
def test_the_normal_of_a_curved_wall_is_of_second_order_beside_the_domain_s_walls(
    axis: int,
) -> None:
    """Velocity on the last closed faces before the domain's upper wall, of a disc that it cuts.

    The distance of a face's center to a disc has the gradient (x - c)/|x - c|. Differences between
    the nodes on both sides of the face differ from it by less than h^2/(8 r^2) = 0.02; one-sided
    differences would differ by h/(2 r) = 0.2.
    """
    last = FLAT.counts[axis] - 1  # coordinate of the last faces before the domain's wall [cells]
    center = 0.5 * np.array(FLAT.counts) * [1, 1, 0]
    center[axis] = last - 1.0
    wall, velocity = RoundWall(tuple(center), 5.0), np.zeros(3)
    velocity[1 - axis] = -1.0
    field = wall.extend(tuple(velocity[:2]))[axis]
    x = face_centers(FLAT, axis)
    judged = (x[..., axis] == last) & (np.abs(wall.signed(x) + 1.0) < 0.7)
    judged[[0, 2]] = False
    judged &= wall.open[axis] == 0
    assert judged.sum() == 2
    normal = (x - wall.center)[judged] / np.linalg.norm(x - wall.center, axis=-1)[judged][:, None]
    expected = velocity[axis] - (normal @ velocity) * normal[:, axis]
    np.testing.assert_allclose(field[judged], expected, atol=0.02)


@pytest.mark.parametrize("towards", [-1.0, 1.0])
def test_closed_faces_take_the_normal_velocity_of_a_wall_that_moves(towards: float) -> None:
    """Closed faces with a moving wall: its normal velocity.

    Held liquid follows a wall in both directions, and has nothing of its tangential velocity.
    """
    slope = SlopedWall(*SLOPES[-1])
    wall = np.array([0.4, -0.2, 0.7]) + 2.0 * towards * slope.normal
    slope.move(wall)
    velocity = np.array([0.3, 0.5, -0.6])
    wanted = velocity - ((velocity - wall) @ slope.normal) * slope.normal
    for axis, field in enumerate(slope.extend(tuple(velocity))):
        assert np.abs(field[slope.judged(axis)] - wanted[axis]).max() < 5e-6


def test_released_liquid_is_pushed_by_a_wall_that_overtakes_it() -> None:
    for speed, holds in ((0.2, True), (-0.2, False)):
        slope = SlopedWall(*SLOPES[0], contact=RELEASED)
        wall = 0.5 * slope.normal
        slope.move(wall)
        velocity = (0.5 - speed) * slope.normal + np.array([slope.normal[1], -slope.normal[0], 0.0])
        wanted = velocity - ((velocity - wall) @ slope.normal) * slope.normal * holds
        for axis, field in enumerate(slope.extend(tuple(velocity[:2]))):
            assert np.abs(field[slope.judged(axis)] - wanted[axis]).max() < 5e-6


@pytest.mark.parametrize(("contact", "speed"), [(RELEASED, -1.0), (HELD, 0.0)])
def test_separation_at_a_sliver_depends_on_the_sliver_itself(contact: int, speed: float) -> None:
    """Released sliver decides, not the cell behind it.

    The wall cell under a ceiling is open for a fifth, and the cell below it touches no wall:
    nothing may hang from that one.
    """
    slope = SlopedWall(FLAT, (0.0, -1.0, 0.0), contact=contact, shift=-0.2)
    row = FLAT.counts[1] // 2 + 1  # of the wall cells
    assert slope.open[0][1, row, 9] == pytest.approx(0.2, abs=0.02)
    assert slope.contact[1, row, 9] == contact
    assert slope.contact[1, row - 1, 9] == TOUCHES_NOTHING
    v = slope.extend((0.0, -1.0))[1][1]
    assert v[row + 1, 5:-5] == pytest.approx(speed, abs=1e-6)
    assert v[row, 5:-5] == pytest.approx(-1.0)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("counts", [(7, 6, 1), (5, 6, 4)])
@settings(max_examples=30, deadline=None)
@given(random_seed=st.integers(0, 10**6))
def test_a_box_is_treated_as_one_of_whole_cells(
    counts: tuple[int, int, int], random_seed: int
) -> None:
    """Box as one of whole cells.

    Without solids the walls are those of the domain, along the grid:
    `warp_lcp.material.velocity_extrapolation` is an oracle.
    """
    grid = StaggeredGrid(counts, 0.1, 2 if counts[2] == 1 else 3)
    rng = np.random.default_rng(random_seed)
    inner = (slice(1, -1),) * 3
    kind = np.full(grid.shape, SOLID, np.int8)
    kind[inner] = rng.choice([AIR, FLUID], size=counts[::-1], p=[0.6, 0.4])
    contact = np.where(
        kind == FLUID, rng.choice([HELD, RELEASED], size=grid.shape), TOUCHES_NOTHING
    ).astype(np.uint8)
    separating = wp.array([random_seed % 3 > 0], dtype=wp.uint8, device="cpu")
    x = points(grid, (0, 0, 0))
    sides = np.min(
        [np.minimum(x[..., d], grid.counts[d] - x[..., d]) for d in range(grid.dimension)], axis=0
    )
    cut = SimpleNamespace(
        distance=wp.array(sides.astype(np.float32), device="cpu"),
        open=[],
        wall=[],
        velocity=None,
        nearest=[],
        separating=separating,
        grid=grid,
        turn=wp.zeros(1, dtype=wp.mat33, device="cpu"),
        shift=wp.zeros(1, dtype=wp.vec3, device="cpu"),
    )
    results = []
    start, weights, marks = [], [], []
    for axis in range(grid.dimension):
        below = np.roll(kind, 1, 2 - axis)
        open_face = (kind != SOLID) & (below != SOLID)
        cut.open.append(wp.array(open_face.astype(np.float32), device="cpu"))
        cut.wall.append(wp.array(np.where(open_face, -1, 0).astype(np.int16), device="cpu"))
        projected = open_face & ((kind == FLUID) | (below == FLUID))
        weights.append(
            (rng.random(grid.shape) < 0.3).astype(np.float32) * ((kind != SOLID) | (below != SOLID))
        )
        marks.append(np.where((kind == SOLID) & (below == SOLID), -1, projected).astype(np.int8))
        start.append(
            (rng.normal(size=grid.shape) * (projected | (weights[-1] > 0))).astype(np.float32)
        )
    layers = 4
    for cuts in (False, True):
        fields = [wp.array(f, device="cpu") for f in start]
        weight = [wp.array(w, device="cpu") for w in weights]
        known = [
            wp.array(np.maximum(m, 0) if cuts else m, dtype=wp.int8, device="cpu") for m in marks
        ]
        liquid, touch = wp.array(kind, device="cpu"), wp.array(contact, device="cpu")
        if cuts:
            extend_velocity_cut(
                grid.everywhere, fields, weight, known, liquid, touch, cut, grid.faces(), layers
            )
        else:
            index = wp.array(np.where(kind == SOLID, 0, -1).astype(np.int32), device="cpu")
            extend_velocity(
                grid.everywhere, fields, weight, known, liquid, touch, index, separating, [], layers
            )
        results.append(([f.numpy() for f in fields], [m.numpy() for m in known]))
    for axis, (voxel, smooth) in enumerate(zip(results[0][0], results[1][0], strict=True)):
        reached = results[0][1][axis] > 0
        if grid.dimension == 2:
            reached[[0, 2]] = False
        # No tent function reaches a face behind the domain's lower wall.
        np.moveaxis(reached, 2 - axis, 0)[0] = False
        assert smooth[reached] == pytest.approx(voxel[reached], abs=1e-6)


def test_spray_keeps_its_own_velocity_on_open_faces_only() -> None:
    slope = SlopedWall(FLAT, (0.0, 1.0, 0.0), kind=AIR)
    cut, marks = slope.cut(), FLAT.faces(wp.int8)
    fields, weights = FLAT.faces(), FLAT.faces()
    floor = int(slope.at[1]) + 1  # row of the plane's closed faces
    fields[1][1, floor + 4, 9:10].fill_(-2.0)
    weights[1][1, floor + 4, 9:10].fill_(1.0)
    fields[1][1, floor - 1, 15:16].fill_(7.0)
    weights[1][1, floor - 1, 15:16].fill_(1.0)
    kind, contact = wp.array(slope.kind, device="cpu"), wp.array(slope.contact, device="cpu")
    extend_velocity_cut(
        FLAT.everywhere, fields, weights, marks, kind, contact, cut, FLAT.faces(), 2
    )
    v, known = fields[1].numpy()[1], marks[1].numpy()[1]
    assert v[floor + 4, 9] == -2.0
    assert v[floor + 2, 9] == -2.0  # two layers from it
    assert known[floor + 4, 9] == 1
    assert known[floor - 1, 15] == 0


@pytest.mark.parametrize(("grid", "normal"), SLOPES)
@pytest.mark.parametrize("contact", [HELD, RELEASED])
def test_liquid_at_rest_at_a_cut_wall_does_not_follow_liquid_that_leaves(
    grid: StaggeredGrid, normal: tuple[float, float, float], contact: int
) -> None:
    """Material at rest on a cut wall is not dragged along by leaving liquid.

    Liquid leaves the plane at 3 m/s; material on closed faces leaves it at 0.06 m/s, and none of
    them lies in another cell.
    """
    slope = SlopedWall(grid, normal, contact=contact)
    away = slope.normal[: grid.dimension]
    weights = [np.where(fraction == 0, 1.0, 0.0) for fraction in slope.open]
    fields = slope.extend(tuple(3.0 * away), closed=tuple(0.06 * away), weights=weights)
    for axis, field in enumerate(fields):
        beside = slope.judged(axis) & (
            (slope.contact == contact) | (np.roll(slope.contact, 1, 2 - axis) == contact)
        )
        if abs(away[axis]) < 0.1:
            continue
        assert beside.sum() > 5
        kept = np.abs(field[beside] - 0.06 * away[axis]) < 1e-6
        assert kept.all() if contact == RELEASED else not kept.any()


def test_deep_faces_are_left_alone() -> None:
    slope = SlopedWall(FLAT, (0.0, 1.0, 0.0))
    fields = slope.extend((0.4, -0.5), layers=6)
    floor = int(slope.at[1]) + 1
    assert fields[1][1, floor, 5:-5] == pytest.approx(0.0, abs=1e-6)
    assert fields[1][1, floor - 2, 5:-5] == pytest.approx(0.0, abs=1e-6)
    assert fields[1][1, floor - 3, 5:-5] == pytest.approx(-0.5)
    assert fields[0][1, floor - 1, 5:-5] == pytest.approx(0.4)
    assert fields[1][1, floor - 7, 5:-5] == pytest.approx(JUNK)
