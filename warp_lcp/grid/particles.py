"""Particles sorted by cell: positions, velocities and the gradients that APIC carries.

In cell order a scatter of momentum costs a seventh of what it costs in random order, a gather a quarter; sorting pays every step.
"""

import typing
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.grid.staggered import StaggeredGrid, cell_index

MARGIN = 1e-3  # how far from a wall particles stay, in cells: well above the rounding of float32 positions in 10^3 cells
CHUNK = 256  # the fewest particles that one thread adds up
THREADS = 1024  # the most threads of a sum, each a partial result that the host reads
COLUMNS = 13  # of a partial result, see `total_kernel`


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
@typing.no_type_check
def key_kernel(
    position: wp.array(dtype=wp.vec3),
    inverse_dx: float,
    nx: int,
    ny: int,
    nz: int,
    key: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
):
    """Number the stored cell that each particle lies in; in 2-D nz = 1 and its plane is k = 1 whatever z is."""
    p = wp.tid()
    x = position[p] * inverse_dx
    i = cell_index(x[0] + 1.0, nx)
    j = cell_index(x[1] + 1.0, ny)
    k = cell_index(x[2] + 1.0, nz)
    key[p] = (k * (ny + 2) + j) * (nx + 2) + i
    order[p] = p


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
@typing.no_type_check
def reorder_kernel(order: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3), target: wp.array(dtype=wp.vec3)):
    """Take the particles in a new order."""
    p = wp.tid()
    target[p] = source[order[p]]


@wp.kernel(enable_backward=False, module="warp_lcp.grid.particles")
@typing.no_type_check
def total_kernel(
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    count: int,
    chunk: int,
    out: wp.array2d(dtype=wp.float64),
):
    """Add up a chunk of particles: [0] |v|^2, [1-3] x, [4-6] lowest x, [7-9] highest x, [10] largest |v|^2, [11-12] bad x and v."""
    t = wp.tid()
    squares = wp.float64(0.0)
    sx = wp.float64(0.0)
    sy = wp.float64(0.0)
    sz = wp.float64(0.0)
    first = position[t * chunk]
    low = first
    high = first
    fastest = float(0.0)
    bad_positions = float(0.0)
    bad_velocities = float(0.0)
    for p in range(t * chunk, wp.min((t + 1) * chunk, count)):
        x = position[p]
        v = velocity[p]
        speed = wp.dot(v, v)
        squares += wp.float64(speed)
        sx += wp.float64(x[0])
        sy += wp.float64(x[1])
        sz += wp.float64(x[2])
        low = wp.min(low, x)
        high = wp.max(high, x)
        fastest = wp.max(fastest, speed)
        if not wp.isfinite(speed):
            bad_velocities += 1.0
        if not wp.isfinite(x[0] + x[1] + x[2]):
            bad_positions += 1.0
    out[t, 0] = squares
    out[t, 1] = sx
    out[t, 2] = sy
    out[t, 3] = sz
    for a in range(3):
        out[t, 4 + a] = wp.float64(low[a])
        out[t, 7 + a] = wp.float64(high[a])
    out[t, 10] = wp.float64(fastest)
    out[t, 11] = wp.float64(bad_positions)
    out[t, 12] = wp.float64(bad_velocities)


@dataclass(frozen=True)
class ParticleTotals:
    """Sums over all particles.

    Attributes:
        count: particles.
        mean_square_speed: [m^2/s^2].
        center: mean position [m], shape (3,).
        low: smallest coordinates [m], shape (3,).
        high: largest coordinates [m], shape (3,).
        max_speed: [m/s].
        bad_positions: particles whose position is not finite.
        bad_velocities: particles whose velocity is not finite (or its square overflows).
    """

    count: int
    mean_square_speed: float
    center: np.ndarray
    low: np.ndarray
    high: np.ndarray
    max_speed: float
    bad_positions: int
    bad_velocities: int

    @property
    def finite(self) -> bool:
        """Whether every position and velocity is finite."""
        return self.bad_positions == 0 and self.bad_velocities == 0


class Particles:
    """Hold a fixed number of particles in arrays that are sorted by cell in place.

    Args:
        grid: the grid whose cells order the particles.
        position: [m], shape (n, 3), n > 0; z = 0 in 2-D.
        velocity: [m/s], shape (n, 3).
        affine: also carry the gradient of each velocity component [1/s].

    Attributes:
        position: [m], wp.vec3, shape (n,).
        velocity: [m/s], wp.vec3, shape (n,).
        affine: gradient of each component [1/s], wp.vec3, shape (n,) each; empty without `affine`.
        key: number of the stored cell of each particle at the last sort, shape (2 n,), the first n in use.

    Raises:
        ValueError: the shapes do not match or there is no particle.
    """

    def __init__(self, grid: StaggeredGrid, position: np.ndarray, velocity: np.ndarray, *, affine: bool) -> None:
        """Copy the particles to the device."""
        n = len(position)
        if n == 0 or position.shape != (n, 3) or velocity.shape != (n, 3):
            raise ValueError(f"position {position.shape} and velocity {velocity.shape}: must both be (n, 3) with n > 0")
        self.grid, self.count = grid, n
        self.position = self._vectors(position)
        self.velocity = self._vectors(velocity)
        self.affine = [self._vectors() for _ in range(grid.dimension)] if affine else []
        self.key = wp.zeros(2 * n, dtype=wp.int32, device=grid.device)
        self._order = wp.zeros(2 * n, dtype=wp.int32, device=grid.device)
        self._spare = self._vectors()
        self._chunk = max(CHUNK, -(-n // THREADS))
        self._partials = wp.zeros((-(-n // self._chunk), COLUMNS), dtype=wp.float64, device=grid.device)

    def _vectors(self, host: np.ndarray | None = None) -> wp.array:
        if host is None:
            return wp.zeros(self.count, dtype=wp.vec3, device=self.grid.device)
        return wp.array(np.ascontiguousarray(host, dtype=np.float32), dtype=wp.vec3, device=self.grid.device)

    def sort(self) -> None:
        """Bring the particles into the order of their cells; equal cells keep their order, so that a run is repeatable."""
        grid = self.grid
        nx, ny, nz = grid.counts
        inputs = [self.position, 1.0 / grid.spacing, nx, ny, nz, self.key, self._order]
        wp.launch(key_kernel, self.count, inputs, device=grid.device)
        wp.utils.radix_sort_pairs(self.key, self._order, self.count, end_bit=grid.size.bit_length())
        self.position = self._reordered(self.position)
        self.velocity = self._reordered(self.velocity)
        for c in range(len(self.affine)):
            self.affine[c] = self._reordered(self.affine[c])

    def _reordered(self, source: wp.array) -> wp.array:
        target = self._spare
        wp.launch(reorder_kernel, self.count, [self._order, source, target], device=self.grid.device)
        self._spare = source
        return target

    def totals(self) -> ParticleTotals:
        """Return sums over the particles as they are now; the same bits on every run."""
        inputs = [self.position, self.velocity, self.count, self._chunk, self._partials]
        wp.launch(total_kernel, self._partials.shape[0], inputs, device=self.grid.device)
        part = self._partials.numpy()
        with np.errstate(invalid="ignore"):  # sums of values that are not finite: counted in the last two columns
            total = part.sum(axis=0)
        return ParticleTotals(
            count=self.count,
            mean_square_speed=float(total[0]) / self.count,
            center=total[1:4] / self.count,
            low=part[:, 4:7].min(axis=0),
            high=part[:, 7:10].max(axis=0),
            max_speed=float(np.sqrt(part[:, 10].max())),
            bad_positions=int(total[11]),
            bad_velocities=int(total[12]),
        )

    def cells_of(self, positions: np.ndarray) -> np.ndarray:
        """Return the interior cell (x, y, z), counted from 0, of positions [m], shape (n, 3)."""
        cells = np.floor(np.nan_to_num(np.asarray(positions, dtype=np.float64)) / self.grid.spacing)
        return np.clip(cells, 0, np.array(self.grid.counts) - 1).astype(int)

    def arrays(self) -> dict[str, wp.array]:
        """Return the particles' arrays by name."""
        named = {"position": self.position, "velocity": self.velocity}
        return named | {f"affine_{c}": gradient for c, gradient in enumerate(self.affine)}


def lattice(grid: StaggeredGrid, per_axis: int, jitter: float, rng: np.random.Generator, plane: int) -> np.ndarray:
    """Return per_axis^dimension points a cell of one plane of cells, each moved at random.

    Args:
        grid: the grid.
        per_axis: points along an edge of a cell.
        jitter: width of the uniform random displacement, as a fraction of the points' spacing.
        rng: source of the displacements.
        plane: which cells along z, counted from 0; 0 in 2-D.

    Returns:
        Points [m], shape (n, 3), z = 0 in 2-D.
    """
    nx, ny, _ = grid.counts
    spacing = grid.spacing / per_axis
    x = np.arange(nx * per_axis) + 0.5
    y = np.arange(ny * per_axis) + 0.5
    z = np.arange(plane * per_axis, (plane + 1) * per_axis) + 0.5 if grid.dimension == 3 else np.zeros(1)
    Z, Y, X = np.meshgrid(z, y, x, indexing="ij")
    points = np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)
    points[:, : grid.dimension] += jitter * (rng.random((len(points), grid.dimension)) - 0.5)
    return points * spacing


def seed(
    grid: StaggeredGrid,
    regions: typing.Sequence[typing.Callable[[np.ndarray], np.ndarray]],
    open_cells: np.ndarray,
    *,
    per_axis: int,
    jitter: float,
    random_seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill regions with particles on a jittered lattice; a point in several regions belongs to the first.

    Args:
        grid: the grid.
        regions: functions that tell for points [m], shape (n, 3), which lie in the region, shape (n,).
        open_cells: which cells may hold particles, shape (nz, ny, nx).
        per_axis: points along an edge of a cell, >= 1.
        jitter: width of the random displacement as a fraction of the points' spacing, 0 <= jitter <= 1.
        random_seed: of the displacements; they do not depend on the regions.

    Returns:
        Positions [m], float32, shape (n, 3), and the region of each, shape (n,).

    Raises:
        ValueError: `per_axis` or `jitter` is out of range.
    """
    if per_axis < 1:
        raise ValueError(f"per_axis = {per_axis}: must be at least 1")
    if not 0.0 <= jitter <= 1.0:
        raise ValueError(f"jitter = {jitter}: must be between 0 and 1")
    rng = np.random.default_rng(random_seed)
    axes, margin = slice(grid.dimension), MARGIN * grid.spacing
    size = np.array(grid.counts) * grid.spacing
    positions, owners = [], []
    for plane in range(grid.counts[2]):
        points = lattice(grid, per_axis, jitter, rng, plane).astype(np.float32)
        np.clip(points[:, axes], margin, size[axes] - margin, out=points[:, axes])
        cells = np.minimum((points.astype(np.float64) / grid.spacing).astype(int), np.array(grid.counts) - 1)
        free = open_cells[plane, cells[:, 1], cells[:, 0]]
        points = points[free]
        owner = np.full(len(points), -1)
        for number, region in enumerate(regions):
            if len(points):
                owner[(owner < 0) & region(points)] = number
        positions.append(points[owner >= 0])
        owners.append(owner[owner >= 0])
    return np.concatenate(positions), np.concatenate(owners)
