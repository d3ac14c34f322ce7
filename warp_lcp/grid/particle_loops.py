"""Passes over particles: division into tasks, and arguments about the grid.

Written plainly, with one thread a particle, the transfers take 71 and 74 ns a particle in 3-D and
the advection 129 (one core, 8 particles a cell, sorted). As native loops over a grain of particles
they take 25, 12 and 34. clang vectorizes a loop over arrays that are declared not to alias, gathers
from the fields included.
"""

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

from warp_lcp.kernels import KernelFile, Rows, StencilKernel
from warp_lcp.kernels.launch_graph import is_recording
from warp_lcp.kernels.recorded_arguments import Scalar, Slot, rows_memory
from warp_lcp.kernels.thread_pool import get_threads
from warp_lcp.kernels.types import DeviceArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from warp_lcp.grid.staggered import StaggeredGrid

# Particles per task of a CPU thread. The launch then costs nothing, and the arrays stay in the L2
# cache.
CPU_GRAIN = 4096
# Tasks per thread where particles add to planes of a field. Chunks that touch two tasks' planes are
# read twice.
SHARES = 2
LEAST_PLANES = 4  # least planes of a task
PARTICLE = 16  # work of a particle in a pass, in cells of a usual pass
LIST_ROOM = 1.25  # factor on the threads of a captured launch over a list's entries
# Distance that particles keep from walls, in cells: well above the rounding of float32 positions in
# 10^3 cells.
MARGIN = 1e-3
KERNELS = KernelFile(Path(__file__).parent / "headers/particles.h")


class ListMemory:
    """List whose length and arrays change between the runs of recorded launches.

    Attributes:
        count: number of entries.
        rows: division into rows of passes over them.
        entries: address of the number of entries, for kernels with a task an entry.
        touched: result array of `touched_planes`.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device, self.count = device, Scalar()
        self.rows = rows_memory(device, LIST_ROOM)
        self._slots: dict[str, Slot] = {}
        self._entries = ctypes.c_int64()
        self.entries = ctypes.addressof(self._entries)
        self.touched = wp.empty(2, dtype=wp.int32, device=device)
        self.slot("touched of").point_to(self.touched)

    def set_list(self, count: int, arrays: Mapping[str, DeviceArray]) -> None:
        """Use a list of this length and these arrays.

        Recorded launches refer to the arrays by name.
        """
        for name, array in arrays.items():
            self.slot(name).point_to(array)
            array.listed = self
        self.resize(count)

    def slot(self, name: str) -> Slot:
        """Return the address of an array of the list."""
        found = self._slots.get(name)
        if found is None:
            found = self._slots[name] = Slot()
        return found

    def resize(self, count: int) -> None:
        """Set the number of entries."""
        if count == self.count.value:
            return
        self.count.value = self._entries.value = count
        if self.device.is_cuda:
            self.rows.set_layout(chunks(count, self.device).single)
        else:
            self.rows.set_entries(count, CPU_GRAIN)
        least = 2 * -(-max(count, 1) // CPU_GRAIN)
        if len(self.touched) < least:
            self.touched = wp.empty(2 * least, dtype=wp.int32, device=self.device)
            self.slot("touched of").point_to(self.touched)


def list_of(array: object) -> ListMemory | None:
    """Return the list whose memory an array is part of; None if it is of none."""
    listed: ListMemory | None = vars(array).get("listed") if isinstance(array, wp.array) else None
    return listed


TOUCHED: dict[type, StencilKernel] = {
    vector: KERNELS.kernel(
        "warp_lcp.grid.touched.touched",
        module=f"warp_lcp.grid.touched_{real.__name__}",
        compute=real,
    )
    for vector, real in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64))
}


def touched_planes(grid: "StaggeredGrid", position: DeviceArray) -> wp.array[wp.int32] | None:
    """Return the planes of a field that the particles of each chunk may add to.

    They are rows in 2-D. Returns None where one thread adds up all.
    """
    if grid.device.is_cuda or get_threads() == 1:
        return None
    listed = list_of(position) if is_recording() else None
    touched = (
        wp.empty(2 * -(-max(len(position), 1) // CPU_GRAIN), dtype=wp.int32, device=grid.device)
        if listed is None
        else listed.touched
    )
    launch(TOUCHED[position.dtype], len(position), grid, position=position, touched=touched)
    return touched


def scatter(
    passed: StencilKernel,
    grid: "StaggeredGrid",
    position: DeviceArray,
    touched: wp.array[wp.int32] | None,
    *structs: "DataclassInstance",
    runs: wp.array[wp.int32] | None = None,
    **kernel_args: object,
) -> None:
    """Launch a pass in which particles add to a field.

    On the CPU each task owns planes (rows in 2-D) of the field, so no two threads write to the
    same.

    Args:
        passed: a kernel with `each_share` of `particles.h`.
        grid: grid of the particles.
        position: positions of the particles.
        touched: result of `touched_planes` for them.
        runs: `runs` of `Particles`.
        structs: further arguments of the pass, see `StencilKernel.bind`.
        kernel_args: likewise.
    """
    count, shares = len(position), 1
    listed = list_of(position) if is_recording() else None
    if not count and listed is None:
        return
    number = count if listed is None else listed.count
    if grid.device.is_cuda:
        rows = Rows.listed(count, grid.device)
        rows = rows if listed is None else replace(rows, memory=listed.rows)
    else:
        planes = grid.shape[3 - grid.dimension]
        shares = 1 if touched is None else min(SHARES * get_threads(), -(-planes // LEAST_PLANES))
        rows = Rows.listed(shares, grid.device, 1, weight=1 << 20)  # a share is a piece
    kernel_args |= {
        "touched": touched,
        "runs": runs,
        "count": number,
        "chunk": CPU_GRAIN,
        "shares": shares,
    }
    kernel_args["position"] = position
    passed.bind_arguments(rows, (grid.placement, *structs), kernel_args).launch()


@dataclass(frozen=True, slots=True)
class GridPlacement:
    """Spacing of a grid and its place in a larger one, for particle kernels.

    Attributes:
        planes: nodes along z that a tent function spans: 1 in 2-D, 2 in 3-D.
        dx: spacing [m].
        inverse_dx: 1 / dx [1/m].
        before_x: cells of the larger grid before the first cell along x.
        before_y: likewise along y.
        before_z: likewise along z.
    """

    planes: int
    dx: float
    inverse_dx: float
    before_x: int
    before_y: int
    before_z: int


def chunks(count: int, device: wp.Device) -> Rows:
    """Return the division of a list's entries into tasks."""
    return Rows.entries(count, device, 1 if device.is_cuda else CPU_GRAIN, weight=PARTICLE)


def launch(
    passed: StencilKernel,
    count: int,
    grid: "StaggeredGrid",
    *structs: "DataclassInstance",
    **kernel_args: object,
) -> None:
    """Launch a pass over the first particles of a list.

    Arguments are bound by `StencilKernel.bind`, with the grid's placement. A recorded launch visits
    as many particles as the list has when it runs, if one of its arrays belongs to a `ListMemory`.
    """
    rows, listed = chunks(count, grid.device), None
    kernel_args = passed.with_members(structs, kernel_args)
    if is_recording():
        memories = map(list_of, kernel_args.values())
        listed = next((memory for memory in memories if memory is not None), None)
    if listed is not None:
        rows = replace(rows, memory=listed.rows)
    if count or listed is not None:
        passed.bind_arguments(rows, (grid.placement,), kernel_args).launch()
