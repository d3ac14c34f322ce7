"""Vectors of the coupled solve: velocities, pressures, and velocities of rigid bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from warp_lcp.fluids.viscosity_multigrid import ViscosityMultigrid
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.window_reduction import WindowReduction
from warp_lcp.kernels import StencilKernel
from warp_lcp.kernels.launch_graph import LaunchGraph


class StokesLayout:
    """Parts of a vector of the coupled solve, see `fluids.stokes_operator`.

    Velocities of all components, x of all cells, and the velocities of rigid bodies. All ranks know
    these, but the first one has their rows: residuals and weights are 0 on the others.

    Args:
        grid: the grid.
        multigrid: the viscous multigrid, whose vectors hold the velocities.
        rank: number of unknowns of bodies.

    Attributes:
        size: number of elements.
        rank: number of unknowns of bodies.
        velocities: the part of the velocities.
    """

    def __init__(self, grid: StaggeredGrid, multigrid: ViscosityMultigrid, rank: int) -> None:
        self._grid, self._multigrid = grid, multigrid
        first = grid.dimension * grid.size
        self.size, self.rank = first + grid.size + rank, rank
        self.velocities = slice(0, first)
        self._pressures = slice(first, first + grid.size)
        self._bodies = slice(first + grid.size, self.size)

    def components(self, vector: wp.array) -> list[wp.array]:
        """Return the velocities, of each component in the stored shape."""
        return self._multigrid.components(vector)

    def pressure(self, vector: wp.array) -> wp.array:
        """Return x in the stored shape."""
        return vector[self._pressures].reshape(self._grid.shape)

    def bodies(self, vector: wp.array) -> np.ndarray:
        """Return the velocities of the bodies, a copy."""
        return np.array(vector[self._bodies].numpy(), dtype=np.float64)

    def set_bodies(self, vector: wp.array, values: np.ndarray) -> None:
        """Store the velocities of the bodies."""
        vector[self._bodies].assign(values.astype(np.float32))

    def body_rows(self, vector: wp.array) -> np.ndarray:
        """Return the rows of the bodies in a residual, a copy; collective."""
        return np.asarray(self._grid.part.ranks.sum(self.bodies(vector)))

    def set_body_rows(self, vector: wp.array, values: np.ndarray) -> None:
        """Store the rows of the bodies in a residual or in weights."""
        self.set_bodies(vector, values * self._grid.part.ranks.is_root)


def launch_graphs(
    device: wp.Device, *functions: Callable[..., None], at_once: bool = False
) -> dict[str, LaunchGraph]:
    """Return the launch graph of each function, by the function's name.

    On CUDA the functions are called in each run instead: some launch multigrid cycles, which are
    programs of their own there, and ranks exchange ghost cells by the host.

    Args:
        device: where the kernels run.
        functions: the functions.
        at_once: whether they have tasks of the host, and are called in each run on the CPU, too.
    """
    at_once = at_once or device.is_cuda
    return {
        function.__name__: LaunchGraph(device, function, at_once=at_once) for function in functions
    }


class WindowSums:
    """Reductions of a kernel that runs once, or once for each component, over all processes.

    The rows of the whole grid are summed, so that results do not depend on the window: the first
    step of a resumed run has a larger one. On ranks these are the rows of this rank's own cells, to
    which the windows of the launches are restricted, see `GridPart.faces`.

    Args:
        kernel: the kernel.
        grid: the grid.
        parts: number of its launches.
    """

    def __init__(self, kernel: StencilKernel, grid: StaggeredGrid, parts: int = 1) -> None:
        counted = grid.part.stored
        self._parts = [WindowReduction(kernel, grid, counted) for _ in range(parts)]
        self._ranks, self._sums = grid.part.ranks, len(kernel.sums)

    def launch(self, window: Window, part: int = 0, **arguments: object) -> None:
        """Launch a part over a window."""
        self._parts[part].launch(window, **arguments)

    def read(self) -> Sequence[float]:
        """Return the results of the last launches, summed over the parts; collective.

        The maxima of a kernel are those of its only launch.
        """
        for part in self._parts:
            part.changed()
        every = self._ranks.gather(np.sum([part.read() for part in self._parts], axis=0))
        sums, largest = np.split(every, [self._sums], axis=1)
        return [float(v) for v in (*sums.sum(axis=0), *largest.max(axis=0))]
