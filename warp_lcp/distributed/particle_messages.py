"""Messages of particles between ranks, packed and unpacked in native code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.distributed.decomposition import CellBox
from warp_lcp.grid.particles import MOST_A_CELL, Particles
from warp_lcp.kernels import KernelFile, Rows, StencilKernel
from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.kernels.recorded_arguments import Scalar, Slot
from warp_lcp.kernels.types import DeviceArray

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain

REACH = 1  # cells from a box within which particles touch its faces and cells
ENDLESS = 1e30  # a coordinate beyond all others
COLUMNS = ("position", "velocity", "affine_0", "affine_1", "affine_2", "kept", "identity")
PLACE_WORDS, COLUMN_WORDS = 2, 3  # words of 4 bytes, of a particle in a message
KERNELS = KernelFile(Path(__file__).parent / "headers/distributed.h")
FIND_BORDER, PACK, UNPACK, SETTLE, GIVE_PLACES = (
    KERNELS[f"warp_lcp.distributed.particles.{name}"]
    for name in ("find_border", "pack", "unpack", "settle", "give_places")
)


class Buffer:
    """Host memory that grows, for recorded launches.

    Args:
        dtype: of its elements, a Warp type.

    Attributes:
        array: the memory now.
        host: the same as a NumPy array.
    """

    def __init__(self, dtype: type) -> None:
        self._dtype, self._slot = dtype, Slot()
        self._allocate(1)

    def reserve(self, count: int, keep: int = 0) -> None:
        """Allocate room for so many elements, and keep the first ones.

        The other elements are not initialized.
        """
        if count > len(self.host):
            before = self.host
            self._allocate(2 * count)
            self.host[:keep] = before[:keep]

    def store(self, values: np.ndarray) -> None:
        """Store these values."""
        self.reserve(values.size)
        self.host[: values.size] = values.ravel()

    def _allocate(self, count: int) -> None:
        self.array: DeviceArray = wp.empty(count, dtype=self._dtype, device="cpu")
        self.host: np.ndarray = self.array.numpy()
        self._slot.point_to(self.array)


class ParticleMessages:
    """Exchange of particles between a rank and its neighbors.

    Args:
        part: the subdomain of this rank.
        particles: this rank's.
        place: int64, of each particle in the order of all ranks' particles; grows with them.
        neighbors: ranks, ascending.
    """

    def __init__(
        self, part: Subdomain, particles: Particles, place: Buffer, neighbors: Sequence[int]
    ) -> None:
        self.part, self._particles, self._place, self._neighbors = part, particles, place, neighbors
        self._boxes, self._border, self._cells, self._found = (Buffer(wp.int32) for _ in range(4))
        self._outgoing, self._incoming, self._others, self._ghosts, self._flags, self._moved = (
            Buffer(wp.int32) for _ in range(6)
        )
        self._offsets = Buffer(wp.float64)
        self._device, self._count, self._come = wp.get_device("cpu"), Scalar(), Scalar()
        self._bounds = bounds_of(part)
        self._end = beyond(part.decomposition.counts, part.grid.spacing)
        self._ends = self._store_boxes()
        self._copies: dict[str, DeviceArray] = {}
        # Columns of a GPU are copied to new arrays in each run.
        copied = particles.grid.device.is_cuda
        launches = (
            self._launch_packing,
            self._launch_unpacking,
            self._launch_settling,
            self._launch_search,
            self._launch_places,
        )
        graphs = (LaunchGraph(self._device, launch, at_once=copied) for launch in launches)
        self._packing, self._unpacking, self._settling, self._search, self._giving = graphs

    def _store_boxes(self) -> list[int]:
        """Set the search boxes; return the number of particles for each neighbor.

        This rank comes last. A neighbor needs the particles in its box and within REACH of it, at
        every periodic shift; this rank itself needs those at nonzero shifts. Boxes are in cells,
        the offsets shift dx of the positions in m.
        """
        part, joined, own_rank = self.part, self.part.decomposition.joined, self.part.ranks.rank
        counts, origin = np.array(part.grid.counts), np.array(part.grid.origin)
        limits = [[0, 0, 0], part.decomposition.counts] if joined else [origin, origin + counts]
        if part.grid.dimension == 2:
            limits = [[*limits[0][:2], origin[2]], limits[1]]
        shifts = part.decomposition.shifts
        ranks = [*self._neighbors, own_rank] if joined else self._neighbors
        seen = [(rank, shift) for rank in ranks for shift in shifts[rank == own_rank :]]
        boxes = [
            part.decomposition.boxes[rank].grown(REACH).moved(shift, -1) for rank, shift in seen
        ]
        table = [limits, _corners(part.box), *map(_corners, boxes)]
        self._boxes.store(np.array(table, dtype=np.int32))
        self._offsets.store(
            np.array([shift for _, shift in seen], dtype=np.float64).reshape(-1, 3)
            * part.grid.spacing
        )
        self._found.reserve(max(1 + len(seen), 3))
        return [sum(rank == other for other, _ in seen) for rank in ranks]

    def exchange(self, *, positions_only: bool) -> int:
        """Exchange particles with the neighbors; return how many have arrived; collective.

        Arrived particles are stored behind the others. A message has 2 words of 4 bytes for each
        particle, and 3 for each of its columns that are sent.

        Args:
            positions_only: send positions and places alone.
        """
        particles, count = self._particles, self._particles.count
        self._fetch(positions_only=positions_only)
        words = PLACE_WORDS + COLUMN_WORDS * (1 if positions_only else self._particles.column_count)
        self._border.reserve(count)
        self._cells.reserve(3 * count)
        self._count.value = count
        self._search.run()
        inside, ends = (
            self._found.host[1 : 1 + sum(self._ends)].tolist(),
            [0, *np.cumsum(self._ends).tolist()],
        )
        to = [words * sum(inside[:end]) for end in ends]
        self._outgoing.reserve(to[-1])
        self._packing.run(positions_only, variant=positions_only)
        messages = [self._outgoing.host[begin:end] for begin, end in pairwise(to)]
        incoming = self.part.mailbox.swap(dict(zip(self._neighbors, messages, strict=False)))
        incoming += messages[len(self._neighbors) :]
        come = sum(map(len, incoming)) // words
        self._store_received(incoming, come, words)
        particles.make_room(come)
        self._place.reserve(count + come, count)
        self._come.value = come
        self._fetch(positions_only=positions_only)
        self._unpacking.run(positions_only, variant=positions_only)
        self._send()
        return come

    def settle(self, come: int) -> tuple[int, int, np.ndarray]:
        """Store ghosts behind this rank's particles, after `exchange` of all columns.

        Args:
            come: result of `exchange`.

        Returns:
            The number of this rank's particles, the number with ghosts, and the indices before this
            rank's end whose particles were replaced.
        """
        counts = self._found.host
        most = int(counts[0]) + come
        for buffer in (self._others, self._ghosts):
            buffer.reserve(most)
        self._flags.reserve(2 * most)
        self._moved.reserve(2 * most * (PLACE_WORDS + COLUMN_WORDS * len(COLUMNS)))
        self._settling.run()
        self._send()
        own, end, free = counts[:3].tolist()
        return own, end, self._others.host[:free].astype(np.int64)

    def give_places(self) -> None:
        """Renumber the particles' places in the order of their cells."""
        self._count.value = self._particles.count
        self._place.reserve(self._particles.count)
        self._giving.run()

    def _store_received(self, incoming: Sequence[np.ndarray], come: int, words: int) -> None:
        self._incoming.reserve(come * words)
        if come:
            np.concatenate(incoming, out=self._incoming.host[: come * words])

    def _fetch(self, *, positions_only: bool) -> None:
        """Copy columns from a GPU."""
        if self._particles.grid.device.is_cuda:
            arrays = self._particles.arrays()
            names = ["position"] if positions_only else list(arrays)
            self._copies = {
                name: wp.array(arrays[name].numpy(), dtype=wp.vec3, device="cpu") for name in names
            }

    def _send(self) -> None:
        """Send the copies back."""
        for name, column in self._copies.items():
            self._particles.arrays()[name].assign(column)

    def _columns(self, positions_only: bool = False) -> dict[str, DeviceArray | None]:
        """Return the columns in the host's memory."""
        arrays = self._copies or self._particles.arrays()
        return dict.fromkeys(COLUMNS) | (
            {"position": arrays["position"]} if positions_only else arrays
        )

    def _launch_search(self) -> None:
        position = self._columns(positions_only=True)["position"]
        numbers = {**self._bounds, "count": self._count, "ends": sum(self._ends)}
        self._bind(
            FIND_BORDER, self._placed | numbers | self._border_found | {"position": position}
        )

    def _launch_packing(self, positions_only: bool) -> None:
        end_x, end_y, end_z = map(float, self._end)
        kernel_args = {
            "message": self._outgoing.array,
            "offsets": self._offsets.array,
            "place": self._place.array,
        }
        numbers = {
            "ends": sum(self._ends),
            "around": bool(self.part.decomposition.joined),
            "end_x": end_x,
            "end_y": end_y,
            "end_z": end_z,
        }
        self._bind(PACK, kernel_args | numbers | self._border_found | self._columns(positions_only))

    def _launch_unpacking(self, positions_only: bool) -> None:
        kernel_args = {
            "message": self._incoming.array,
            "found": self._found.array,
            "place": self._place.array,
        }
        self._bind(
            UNPACK,
            kernel_args
            | self._columns(positions_only)
            | {"count": self._count, "come": self._come},
        )

    def _launch_settling(self) -> None:
        kernel_args = {
            "message": self._moved.array,
            "others": self._others.array,
            "ghosts": self._ghosts.array,
            "flags": self._flags.array,
        }
        kernel_args |= {"place": self._place.array, "count": self._count, "come": self._come}
        self._bind(
            SETTLE, self._placed | self._bounds | self._border_found | kernel_args | self._columns()
        )

    def _launch_places(self) -> None:
        grid, key = self.part.grid, self._particles.key
        key = wp.array(key.numpy(), dtype=wp.int32, device="cpu") if key.device.is_cuda else key
        numbers = dict(
            zip(("all_x", "all_y", "all_z"), self.part.decomposition.counts, strict=True)
        ) | {"most_a_cell": MOST_A_CELL}
        numbers |= dict(
            zip(
                ("before_x", "before_y", "before_z", "nx", "ny"),
                (*grid.origin, *grid.counts[:2]),
                strict=True,
            )
        )
        kernel_args = {
            "key": key,
            "place": self._place.array,
            "found": self._found.array,
            "count": self._count,
        }
        self._bind(GIVE_PLACES, kernel_args | numbers)

    @property
    def _border_found(self) -> dict[str, DeviceArray]:
        return {
            "boxes": self._boxes.array,
            "border": self._border.array,
            "cells": self._cells.array,
            "found": self._found.array,
        }

    @property
    def _placed(self) -> dict[str, float | int]:
        return asdict(self.part.grid.placement)

    def _bind(self, kernel: StencilKernel, given: Mapping[str, object]) -> None:
        kernel.bind_arguments(Rows.entries(1, self._device), (), dict(given)).launch()


def bounds_of(part: Subdomain) -> dict[str, float]:
    """Return the bounds of a rank's box, for kernels.

    Sides that are not cuts are unbounded.
    """
    bits = [[part.cuts >> 2 * axis + side & 1 for axis in range(3)] for side in range(2)]
    low = [box + 1 if cut else -ENDLESS for box, cut in zip(part.box.low, bits[0], strict=True)]
    high = [box + 1 if cut else ENDLESS for box, cut in zip(part.box.high, bits[1], strict=True)]
    names = ("low_x", "low_y", "low_z", "high_x", "high_y", "high_z")
    return {**dict(zip(names, map(float, low + high), strict=True)), "reach": float(REACH)}


def beyond(counts: Sequence[int], spacing: float) -> np.ndarray:
    """Return the coordinates [m] beyond the last cell along x, y, z.

    They are the least float32 numbers that kernels assign to the cell beyond the last.
    """
    one, inverse = np.float32(1.0), np.float32(1.0 / spacing)
    end = np.array(counts, dtype=np.float32) * np.float32(spacing)
    while (short := end * inverse + one < np.array(counts, dtype=np.float32) + one).any():
        end[short] = np.nextafter(end[short], np.float32(np.inf))
    return end


def _corners(box: CellBox) -> list[Sequence[int]]:
    return [box.low, box.high]
