# mypy: ignore-errors
"""Transfer of viscosities that differ from particles to cells and edges.

Layers in a cube around a cell or edge, with shares f_n of its volume:

- Shear across the layers has one stress s in all of them, and rates s / mu_n that add up to
  s sum f_n / mu_n: the viscosity of the mixture is the harmonic mean, 1 / sum f_n / mu_n.
- Stretching along the layers has one rate in all of them, and stresses that add up: the viscosity
  of the mixture is the arithmetic mean, sum f_n mu_n.

Stresses of layers that lie along the grid are of the first kind on edges (e_xy), of the second in
cells (e_xx, e_yy) [Deubelbeiss & Kaus 2008]. So an edge has the harmonic mean of the particles in
its cube, whose ends are the links' ends, and a cell the arithmetic mean of its own. An interface is
then as sharp as the grid, wherever it cuts a cell.
"""

import warp as wp

from warp_lcp.grid.cell_kernel import F32, INTS, POINTS, cell_kernel
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.staggered import StaggeredGrid, Window

MODULE = "fluids.viscosity_transfer"


@cell_kernel(MODULE)
def cells_kernel(
    k, j, i, offsets: INTS, position: POINTS, viscosity: POINTS, planes: int, mean: F32
):
    """Average the viscosities of a cell's particles; of those around it if it has none."""
    # mean = sum of mu_p / n over the n particles of the cell, or, if it has none, of the 3^d cells
    # around it: the arithmetic mean, see above.
    sum = float(0.0)
    count = int(0)
    row = (k * mean.shape[1] + j) * mean.shape[2]
    for p in range(offsets[row + i], offsets[row + i + 1]):
        sum += viscosity[p][0]
        count += 1
    if count == 0:
        for c in range(wp.max(k - planes + 1, 0), wp.min(k + planes, mean.shape[0])):
            for b in range(wp.max(j - 1, 0), wp.min(j + 2, mean.shape[1])):
                row = (c * mean.shape[1] + b) * mean.shape[2]
                for p in range(
                    offsets[row + wp.max(i - 1, 0)], offsets[row + wp.min(i + 2, mean.shape[2])]
                ):
                    sum += viscosity[p][0]
                    count += 1
    mean[k, j, i] = sum / float(wp.max(count, 1))


@cell_kernel(MODULE)
def edges_kernel(
    k,
    j,
    i,
    one: int,
    other: int,
    offsets: INTS,
    position: POINTS,
    viscosity: POINTS,
    origin: wp.vec3i,
    dx: float,
    in_cells: F32,
    mean: F32,
):
    """Average the viscosities in the cube of an edge harmonically.

    Without particles there, those in the cells around it, then the means of these cells.

    Args:
        k: plane of the edge.
        j: row of the edge.
        i: place in its row.
        one: first of the two axes across the edge.
        other: second axis across the edge.
        offsets: first particle of each cell.
        position: positions of the particles [m].
        viscosity: viscosity of each particle in all components, relative to that of the scene.
        origin: cells of the larger grid before the first cell of this one.
        dx: edge of a cell [m].
        in_cells: mean viscosity of cells, 0 without particles near.
        mean: harmonic mean, 0 without particles (written).
    """
    x = float(i + origin[0] - 1)
    y = float(j + origin[1] - 1)
    z = float(k + origin[2] - 1)
    inverse = float(0.0)
    count = int(0)
    inverse_around = float(0.0)
    count_around = int(0)
    low_k = wp.where(other == 2, wp.max(k - 1, 0), k)
    low_j = wp.where(one == 1 or other == 1, wp.max(j - 1, 0), j)
    low_i = wp.where(one == 0, wp.max(i - 1, 0), i)
    for c in range(low_k, k + 1):
        for b in range(low_j, j + 1):
            row = (c * mean.shape[1] + b) * mean.shape[2]
            for p in range(offsets[row + low_i], offsets[row + i + 1]):
                part = 1.0 / viscosity[p][0]
                far = wp.vec3(
                    wp.where(one == 0, wp.abs(position[p][0] / dx - x), 0.0),
                    wp.where(one == 1 or other == 1, wp.abs(position[p][1] / dx - y), 0.0),
                    wp.where(other == 2, wp.abs(position[p][2] / dx - z), 0.0),
                )
                inverse_around += part
                count_around += 1
                if wp.max(far) <= 0.5:
                    inverse += part
                    count += 1
    if count > 0:
        mean[k, j, i] = float(count) / inverse
    elif count_around > 0:
        mean[k, j, i] = float(count_around) / inverse_around
    else:
        for c in range(low_k, k + 1):
            for b in range(low_j, j + 1):
                for a in range(low_i, i + 1):
                    if in_cells[c, b, a] > 0.0:
                        inverse += 1.0 / in_cells[c, b, a]
                        count += 1
        mean[k, j, i] = wp.where(count > 0, float(count) / wp.max(inverse, 1.0e-30), 0.0)


class MixedViscosity:
    """Viscosities of cells and edges, relative to that of the scene; 0 without particles.

    Args:
        grid: the grid.

    Attributes:
        cells: arithmetic mean over the particles of each cell.
        edges: harmonic mean over the particles in the cube of each edge, by pairs of axes.
    """

    def __init__(self, grid: StaggeredGrid) -> None:
        self.grid, self.cells = grid, grid.field()
        pairs = [(0, 1)] if grid.dimension == 2 else [(0, 1), (0, 2), (1, 2)]
        self.edges = {pair: grid.field() for pair in pairs}

    def transfer(self, particles: Particles, window: Window) -> None:
        """Average the particles' viscosities in a window; collective."""
        grid = self.grid
        order = [particles.offsets, particles.position, particles.kept]
        window.launch(cells_kernel, [*order, grid.planes, self.cells])
        for (one, other), mean in self.edges.items():
            place = [wp.vec3i(*grid.origin), grid.spacing]
            window.launch(edges_kernel, [one, other, *order, *place, self.cells, mean])
        # Ghost particles near the outer edge lack neighbors, so ghost values come from their
        # owners.
        grid.part.fill(self.cells, *self.edges.values())
