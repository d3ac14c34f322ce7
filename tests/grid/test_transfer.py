"""Transfers between particles and grid: consistency, conservation and losses.

The tests are those of validation.md 6.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.grid.level_set import particle_density
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.transfer import faces_to_particles, particles_to_faces

REALS = {
    "float32": (wp.float32, wp.vec3, np.float32, 1e-5),
    "float64": (wp.float64, wp.vec3d, np.float64, 1e-12),
}
GRIDS = {"2d": StaggeredGrid((9, 7, 1), 0.125, 2), "3d": StaggeredGrid((8, 7, 6), 0.125, 3)}


@dataclass
class TransferCloud:
    """Particles away from the walls, and the target fields of their transfers."""

    grid: StaggeredGrid
    position: wp.array
    velocity: wp.array
    affine: list[wp.array]
    fields: list[wp.array]
    weights: list[wp.array]

    def to_faces(self) -> None:
        particles_to_faces(
            self.grid, self.position, self.velocity, self.affine, self.fields, self.weights
        )

    def to_particles(self, **options) -> None:
        faces_to_particles(
            self.grid, self.fields, self.position, self.velocity, self.affine, **options
        )


def cloud(
    grid: StaggeredGrid, real: str, *, affine: bool, n: int = 300, random_seed: int = 4711
) -> TransferCloud:
    scalar, vector, numpy_type, _ = REALS[real]
    rng = np.random.default_rng(random_seed)
    size = np.array(grid.counts) * grid.spacing
    position = (0.2 + 0.6 * rng.random((n, 3))) * size
    position[:, grid.dimension :] = 0.0

    def vectors(values: np.ndarray) -> wp.array:
        values = values.copy()
        values[:, grid.dimension :] = 0.0
        return wp.array(values.astype(numpy_type), dtype=vector, device="cpu")

    gradients = [vectors(rng.normal(size=(n, 3))) for _ in range(grid.dimension)] if affine else []
    return TransferCloud(
        grid,
        vectors(position),
        vectors(rng.normal(size=(n, 3)) + 0.4),
        gradients,
        grid.faces(scalar),
        grid.faces(scalar),
    )


def node_points(grid: StaggeredGrid, axis: int) -> np.ndarray:
    """Return the nodes of a component [m], shape (*grid.shape, 3); z = 0 in 2-D."""
    k, j, i = np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij")
    points = np.stack([i, j, k], axis=-1) - 0.5
    points[..., axis] -= 0.5
    points *= grid.spacing
    if grid.dimension == 2:
        points[..., 2] = 0.0
    return points


def momentum(c: TransferCloud) -> np.ndarray:
    return c.velocity.numpy().astype(np.float64).sum(axis=0)


def angular_momentum(c: TransferCloud) -> np.ndarray:
    """Return the angular momentum: a sum over particles and components.

    The affine part contributes f (1 - f) dx^2 along each axis.
    """
    x, v = c.position.numpy().astype(np.float64), c.velocity.numpy().astype(np.float64)
    total = np.cross(x, v).sum(axis=0)
    dx = c.grid.spacing
    for axis, gradient in enumerate(c.affine):
        y = x / dx + 0.5
        y[:, axis] += 0.5
        f = y - np.floor(y)
        spread = (f * (1.0 - f) * dx**2) * gradient.numpy().astype(np.float64)
        if c.grid.dimension == 2:
            spread[:, 2] = 0.0
        total += np.cross(spread, np.eye(3)[axis]).sum(axis=0)
    return total


def grid_momenta(c: TransferCloud) -> tuple[np.ndarray, np.ndarray]:
    linear, angular = np.zeros(3), np.zeros(3)
    for axis, (field, weight) in enumerate(zip(c.fields, c.weights, strict=True)):
        p = field.numpy().astype(np.float64) * weight.numpy().astype(np.float64)
        linear[axis] = p.sum()
        angular += np.cross(node_points(c.grid, axis), np.eye(3)[axis] * p[..., None]).sum(
            axis=(0, 1, 2)
        )
    return linear, angular


@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("dimension", GRIDS)
def test_apic_conserves_linear_and_angular_momentum(dimension: str, real: str) -> None:
    c = cloud(GRIDS[dimension], real, affine=True)
    # Relative to the sum without cancellation; arms are about 1 m.
    tolerance = REALS[real][3] * float(np.linalg.norm(c.velocity.numpy(), axis=1).sum())
    before = momentum(c), angular_momentum(c)
    c.to_faces()
    on_grid = grid_momenta(c)
    c.to_particles()
    after = momentum(c), angular_momentum(c)
    for found in (on_grid, after):
        assert found[0] == pytest.approx(before[0], abs=tolerance)
        assert found[1] == pytest.approx(before[1], abs=tolerance)


@pytest.mark.parametrize("dimension", GRIDS)
def test_pic_conserves_linear_and_loses_angular_momentum(dimension: str) -> None:
    losses = {}
    for affine in (False, True):
        c = cloud(GRIDS[dimension], "float64", affine=affine)
        x = c.position.numpy()
        spin = np.cross([0.0, 0.0, 1.0], x - x.mean(axis=0))
        c.velocity.assign(spin)
        for axis, gradient in enumerate(c.affine):
            gradient.assign(np.tile(np.cross([0.0, 0.0, 1.0], np.eye(3)).T[axis], (len(x), 1)))
        linear, before = momentum(c), angular_momentum(c)[2]
        c.to_faces()
        c.to_particles()
        assert momentum(c) == pytest.approx(linear, abs=1e-10)
        losses[affine] = 1.0 - angular_momentum(c)[2] / before
    assert losses[False] > 0.01
    assert abs(losses[True]) < 1e-10


@pytest.mark.parametrize("dimension", GRIDS)
def test_apic_reproduces_a_linear_field(dimension: str) -> None:
    grid = GRIDS[dimension]
    c = cloud(grid, "float64", affine=True)
    rng = np.random.default_rng(57)
    slope, offset = rng.normal(size=(3, 3)), rng.normal(size=3)
    slope[:, grid.dimension :] = 0.0
    for axis, field in enumerate(c.fields):
        field.assign(node_points(grid, axis) @ slope[axis] + offset[axis])
    c.to_particles()
    expected = c.position.numpy() @ slope.T + offset
    axes = slice(grid.dimension)
    assert c.velocity.numpy()[:, axes] == pytest.approx(expected[:, axes], abs=1e-10)
    for axis, gradient in enumerate(c.affine):
        assert gradient.numpy() == pytest.approx(np.tile(slope[axis], (len(expected), 1)), abs=1e-9)
    c.to_faces()
    for axis, (field, weight) in enumerate(zip(c.fields, c.weights, strict=True)):
        used = weight.numpy() > 1e-9
        assert field.numpy()[used] == pytest.approx(
            (node_points(grid, axis) @ slope[axis] + offset[axis])[used], abs=1e-8
        )


@pytest.mark.parametrize("dimension", GRIDS)
def test_scatter_is_the_adjoint_of_gather(dimension: str) -> None:
    grid = GRIDS[dimension]
    c = cloud(grid, "float64", affine=False)
    v = c.velocity.numpy().copy()
    c.to_faces()
    momenta = [f.numpy() * w.numpy() for f, w in zip(c.fields, c.weights, strict=True)]
    rng = np.random.default_rng(20)
    tests = [rng.normal(size=grid.shape) for _ in c.fields]
    for field, values in zip(c.fields, tests, strict=True):
        field.assign(values)
    c.to_particles()
    gathered = c.velocity.numpy()
    for axis in range(grid.dimension):
        assert (momenta[axis] * tests[axis]).sum() == pytest.approx(
            (v[:, axis] * gathered[:, axis]).sum(), rel=1e-12
        )


def test_the_weights_of_a_particle_sum_to_one() -> None:
    for grid in GRIDS.values():
        c = cloud(grid, "float32", affine=False)
        c.to_faces()
        for weight in c.weights:
            assert weight.numpy().sum() == pytest.approx(len(c.position), rel=1e-5)


def test_a_plane_of_particles_touches_its_own_plane_only() -> None:
    c = cloud(GRIDS["2d"], "float32", affine=True)
    c.to_faces()
    for field, weight in zip(c.fields, c.weights, strict=True):
        assert (weight.numpy()[[0, 2]] == 0).all()
        assert (field.numpy()[[0, 2]] == 0).all()


def test_flip_keeps_what_the_grid_did_not_change() -> None:
    grid = GRIDS["3d"]
    c = cloud(grid, "float32", affine=False)
    v = c.velocity.numpy().copy()
    c.to_faces()
    saved = [wp.clone(field) for field in c.fields]
    for field in c.fields:
        field.assign(field.numpy() + 0.25)
    c.to_particles(saved=saved, flip=1.0)
    assert c.velocity.numpy() == pytest.approx(v + 0.25, abs=1e-5)
    pic = cloud(grid, "float32", affine=False)
    faces_to_particles(grid, c.fields, pic.position, pic.velocity, [])
    blend = cloud(grid, "float32", affine=False)
    faces_to_particles(grid, c.fields, blend.position, blend.velocity, [], saved=saved, flip=0.4)
    assert blend.velocity.numpy() == pytest.approx(
        0.6 * pic.velocity.numpy() + 0.4 * c.velocity.numpy(), abs=1e-5
    )


def test_a_particle_on_a_cell_boundary_gives_weight_to_both_faces_of_its_cell() -> None:
    grid = GRIDS["2d"]
    position = wp.array([[2 * grid.spacing, 3 * grid.spacing, 0.0]], dtype=wp.vec3, device="cpu")
    velocity = wp.array([[1.0, 2.0, 0.0]], dtype=wp.vec3, device="cpu")
    fields, weights = grid.faces(), grid.faces()
    particles_to_faces(grid, position, velocity, [], fields, weights)
    assert (weights[0].numpy()[1, 3:5, 3:5].max(axis=0) > 0).all()
    assert (weights[1].numpy()[1, 4:6, 2:4].max(axis=1) > 0).all()
    assert fields[0].numpy()[1, 4, 4] == pytest.approx(1.0)
    assert fields[1].numpy()[1, 5, 3] == pytest.approx(2.0)


def test_a_window_that_holds_the_particles_changes_nothing() -> None:
    grid = GRIDS["3d"]
    c = cloud(grid, "float32", affine=True)
    c.to_faces()
    everywhere = [field.numpy().copy() for field in c.fields]
    cells = np.floor(c.position.numpy() / grid.spacing).astype(int) + 1
    window = grid.window(cells.min(axis=0), cells.max(axis=0), grow=1)
    particles_to_faces(grid, c.position, c.velocity, c.affine, c.fields, c.weights, window=window)
    for field, expected in zip(c.fields, everywhere, strict=True):
        assert (field.numpy() == expected).all()


def sorted_cloud(grid: StaggeredGrid, *, affine: bool, n: int = 4000) -> Particles:
    """Return sorted particles all over the domain, some on boundaries between cells."""
    rng = np.random.default_rng(613)
    size = np.array(grid.counts) * grid.spacing
    position = np.clip(rng.random((n, 3)) * size, 1e-3 * grid.spacing, size - 1e-3 * grid.spacing)
    on_a_face = np.round(position[: n // 8] / grid.spacing) * grid.spacing
    position[: n // 8] = np.where(
        (on_a_face > 0) & (on_a_face < size), on_a_face, position[: n // 8]
    )
    velocity = rng.normal(size=(n, 3))
    for values in (position, velocity):
        values[:, grid.dimension :] = 0.0
    particles = Particles(grid, position, velocity, affine=affine, indexed=True)
    for gradient in particles.affine:
        gradient.assign(rng.normal(size=(n, 3)).astype(np.float32))
    particles.sort()
    return particles


def transfer(p: Particles, offsets: wp.array | None, **options) -> list[np.ndarray]:
    fields, weights = p.grid.faces(), p.grid.faces()
    particles_to_faces(
        p.grid, p.position, p.velocity, p.affine, fields, weights, offsets=offsets, **options
    )
    return [array.numpy() for array in (*fields, *weights)]


@pytest.mark.parametrize("affine", [True, False])
@pytest.mark.parametrize("dimension", GRIDS)
def test_faces_gather_what_particles_scatter(dimension: str, affine: bool) -> None:
    p = sorted_cloud(GRIDS[dimension], affine=affine)
    scattered, gathered = transfer(p, None), transfer(p, p.offsets)
    for a, b in zip(scattered, gathered, strict=True):
        assert b == pytest.approx(a, abs=2e-5 * float(np.abs(a).max()))
        assert ((a != 0) == (b != 0)).all()


def test_gathering_is_confined_to_the_window() -> None:
    p = sorted_cloud(GRIDS["3d"], affine=True)
    window = p.grid.window((2, 2, 2), (5, 4, 3))
    inside = tuple(slice(a, b) for a, b in zip(window.low, window.high, strict=True))
    for a, b in zip(transfer(p, p.offsets), transfer(p, p.offsets, window=window), strict=True):
        assert (b[inside] == a[inside]).all()
        b[inside] = 0.0
        assert (b == 0.0).all()


@pytest.mark.parametrize("affine", [True, False])
@pytest.mark.parametrize("dimension", GRIDS)
def test_planes_that_a_thread_takes_together_have_the_same_bits(
    dimension: str, affine: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On CUDA, and in its emulation; the CPU takes planes one by one."""
    p = sorted_cloud(GRIDS[dimension], affine=affine)
    inner = p.grid.window((1, 2, 2), (2 if p.grid.dimension == 2 else 6, 5, 6))
    found = []
    for least in (1 << 40, 0):
        monkeypatch.setattr("warp_lcp.grid.staggered.MANY_CELLS", least)
        for window in (p.grid.everywhere, inner):
            density = wp.zeros(p.grid.shape, dtype=wp.float32, device="cpu")
            particle_density(p.grid, p, window, 8, density)
            fields = transfer(p, p.offsets, window=window)
            found.append([field.tobytes() for field in (*fields, density.numpy())])
    assert found[0] == found[2]
    assert found[1] == found[3]
    assert found[0] != found[1]


@pytest.mark.cuda
def test_a_gpu_gathers_the_same_bits_every_time() -> None:
    p = sorted_cloud(StaggeredGrid((8, 7, 6), 0.125, 3, "cuda:0"), affine=True)
    once = transfer(p, p.offsets)
    for _ in range(5):
        assert all((a == b).all() for a, b in zip(transfer(p, p.offsets), once, strict=True))


PLACES = {
    "sorted": lambda rng, n: np.sort(rng.random(n)),
    "shuffled": lambda rng, n: rng.random(n),
    "in one plane": lambda rng, n: np.full(n, 0.4),
    "at both ends": lambda rng, n: np.where(rng.random(n) < 0.5, 0.002, 0.998),
    "downward, then some more": lambda rng, n: np.append(
        np.sort(rng.random(n - n // 4))[::-1], rng.random(n // 4) ** 4
    ),
}


@pytest.mark.cpu_form("CUDA has no shares of planes")
@pytest.mark.parametrize("places", PLACES)
@pytest.mark.parametrize("dimension", [2, 3])
def test_threads_add_up_in_the_order_of_one(
    dimension: int, places: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums of several threads in the order of one.

    However particles lie, and however many threads there are: the bits of one thread, and the
    weights of a plain loop.
    """
    monkeypatch.setattr("warp_lcp.grid.particle_loops.CPU_GRAIN", 64)
    n, rng, before = 1500, np.random.default_rng([dimension, len(places)]), wl.get_threads()
    grid = StaggeredGrid((6, 60, 1) if dimension == 2 else (6, 5, 60), 0.5, dimension, "cpu")
    points = rng.random((n, 3))
    points[:, dimension - 1] = PLACES[places](rng, n)
    points = (points * (grid.extent - 2e-3) + 1e-3).astype(np.float32)
    points[:, dimension:] = 0.0
    particles = Particles(grid, points, rng.normal(size=(n, 3)), affine=True, indexed=False)

    def added(threads: int) -> list[np.ndarray]:
        wl.set_threads(threads)
        fields, weights, density = grid.faces(), grid.faces(), grid.field()
        particles_to_faces(
            grid, particles.position, particles.velocity, particles.affine, fields, weights
        )
        particle_density(grid, particles, grid.everywhere, 4, density)
        return [a.numpy() for a in (*fields, *weights, density)]

    try:
        one, *others = (added(threads) for threads in (1, 2, 3, 7))
    finally:
        wl.set_threads(before)
    for other in others:
        for a, b in zip(one, other, strict=True):
            assert a.tobytes() == b.tobytes()
    expected = np.zeros(grid.shape)
    corner = grid.to_grid(points) - [0.0, 0.5, 0.5]  # of the u faces
    cell, share = np.floor(corner).astype(int), corner - np.floor(corner)
    for offset in np.ndindex(2, 2, dimension - 1):
        weight = np.prod(
            [
                np.where(o, f, 1.0 - f)
                for o, f in list(zip(offset, share.T, strict=True))[:dimension]
            ],
            axis=0,
        )
        at = cell + offset
        np.add.at(
            expected,
            (at[:, 2] if dimension == 3 else np.ones(n, dtype=int), at[:, 1], at[:, 0]),
            weight,
        )
    np.testing.assert_allclose(one[dimension], expected, atol=3e-5 * expected.max())
