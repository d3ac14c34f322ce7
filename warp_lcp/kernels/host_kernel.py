"""Kernels on host memory: NumPy arrays in, one native call, NumPy arrays out."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from warp_lcp.kernels.kernel_variant import PLACE
from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.kernels.recorded_arguments import Scalar, rows_memory
from warp_lcp.kernels.rows import Rows
from warp_lcp.kernels.stencil_kernel import StencilKernel
from warp_lcp.kernels.types import DeviceArray


class HostKernel(threading.local):
    """Memory and recorded launch of a kernel for loops that are slow in NumPy.

    Each Python thread has its own.

    Args:
        kernel: has `reals` (float64) and `indices` (int32) as `whole`, float64 fields of its tasks
            as `box`, and numbers.
        numbers: of the kernel that are the same in all runs.
    """

    def __init__(self, kernel: StencilKernel, **numbers: float) -> None:
        self._kernel, self._room, self._tasks = kernel, [0, 0, 0], 0
        self._numbers = {
            name: Scalar(numbers.get(name, 0)) for name in kernel.numbers if name not in PLACE
        }

    def run(
        self,
        reals: Sequence[np.ndarray],
        indices: Sequence[np.ndarray | Sequence[int]],
        *,
        tasks: int = 1,
        work: int = 0,
        places: int = 0,
        **numbers: float,
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Run the kernel.

        Args:
            reals: arrays that are stored in `reals` of the kernel, one after the other.
            indices: arrays that are stored in `indices`.
            tasks: number of elements of each field in `box`, which are 0 before.
            work: additional room in `reals` behind those arrays, which is not cleared.
            places: likewise in `indices`.
            numbers: of the kernel.

        Returns:
            `reals` and each field in `box`: the memory itself, which the next run overwrites.
        """
        pieces, room = [f.ravel() for f in reals], self._room
        filled, listed = sum(map(len, pieces)), sum(map(len, indices))
        if filled + work > room[0] or listed + places > room[1] or tasks > room[2]:
            self._reserve(filled + work, listed + places, tasks)
        np.concatenate(pieces, out=self._reals[:filled])
        if listed:
            np.concatenate(indices, out=self._indices[:listed], casting="same_kind")
        for name, value in numbers.items():
            number = self._numbers[name]
            if number.value != value:
                number.value = value
        fields = [field[:tasks] for field in self._fields]
        for field in fields:
            field[:] = 0.0
        if tasks != self._tasks:
            self._tasks = tasks
            self._rows.set_layout(Rows.entries(tasks, self._device).single)
        self._graph.run()
        return self._reals, fields

    def _launch(self) -> None:
        rows = replace(Rows.entries(self._tasks, self._device), memory=self._rows)
        self._kernel.bind_arguments(rows, (), {**self._arrays, **self._numbers}).launch()

    def _reserve(self, *sizes: int) -> None:
        """Allocate at least so many reals, indices and tasks.

        The new memory has twice the requested size.
        """
        reals, indices, tasks = self._room = [
            max(2 * size, room, 1) for size, room in zip(sizes, self._room, strict=True)
        ]
        self._reals, self._indices = np.zeros(reals), np.zeros(indices, dtype=np.int32)
        self._fields = [np.zeros(tasks) for _ in self._kernel.box]
        self._arrays = {
            name: _warp(values) for name, values in zip(self._kernel.box, self._fields, strict=True)
        }
        self._arrays |= {"reals": _warp(self._reals), "indices": _warp(self._indices)}
        self._device = wp.get_device("cpu")
        # Created here and not earlier: an import must not start Warp.
        self._rows, self._tasks = rows_memory(self._device), 0
        self._graph = LaunchGraph(self._device, self._launch)


def _warp(values: np.ndarray) -> DeviceArray:
    """Return contiguous values with Warp's type, in the same memory."""
    return wp.array(
        values,
        dtype=wp.float64 if values.dtype == np.float64 else wp.int32,
        device="cpu",
        copy=False,
    )
