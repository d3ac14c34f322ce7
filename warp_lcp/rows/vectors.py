"""Flat fields: conversions, inner products, deterministic sums. The only vector primitives that the solvers use.

Every operator stores its fields as flat arrays (see `warp_lcp.rows.fields`), so that these serve all of them.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol, no_type_check

import numpy as np
import warp as wp

from warp_lcp.rows import RowPass, Rows
from warp_lcp.rows.native import HEADERS, text
from warp_lcp.rows.program import Launch, perform

CUDA_BLOCK = 256  # threads that add up partial sums
CUDA_SEGMENTS = 256  # blocks that do so first where there are very many
DOT = RowPass("vectors.dot", HEADERS / "dot.h", wp.float64, reads={"a": "A", "b": "B"}, sums=("ab",))
ADD = RowPass("vectors.add", HEADERS / "add.h", "S", reads={"z": "S"}, writes={"x": "S"})  # x += z
ADD_UP = RowPass(
    "vectors.add_up", HEADERS / "add_up_columns.h", wp.float64, whole={"partials": wp.float64, "scalars": wp.float64},
    numbers={"count": int, "slot": int},
)  # fmt: skip
CONVERT = RowPass("vectors.convert", HEADERS / "convert.h", "B", reads={"a": "A"}, writes={"b": "B"})


@wp.func_native("\n".join(["", text(HEADERS / "native.h"), text(HEADERS / "add_up.h"), ""]))
def add_up_span(partials: wp.array(dtype=wp.float64), offset: int, start: int, n: int, stride: int) -> wp.float64:
    """The sum of every stride-th of the partial sums from `offset` + `start` on."""


@no_type_check
@wp.kernel(enable_backward=False, module="warp_lcp.vectors")
def add_up_kernel(partials: wp.array(dtype=wp.float64), n: int, threads: int, segments: int, out: wp.array(dtype=wp.float64), slot: int):
    """out[slot + column * segments + segment] = the sum of every `segments`-th block of a column of n partials, by one block of threads.

    The order of the additions does not change from run to run.
    """
    t = wp.tid()
    block = t // threads
    column = block // segments
    segment = block - column * segments
    s = add_up_span(partials, column * n, segment * threads + t - block * threads, n, threads * segments)
    total = wp.tile_sum(wp.tile(s))
    if t == block * threads:
        out[slot + block] = total[0]


class Across(Protocol):
    """Who else has a part of the unknowns: the ranks of a distributed problem. All methods are collective, with one answer for all."""

    def sum(self, values: Any) -> Any:
        """Return sums over all parts, entry by entry."""

    def max(self, values: Any) -> Any:
        """Return the largest over all parts, entry by entry."""

    def any(self, condition: bool) -> bool:
        """Return whether it holds in some part."""

    def join(self, key: bytes) -> bytes:
        """Return a key that stands for the keys of all parts."""


class Reduction:
    """Sums over flat fields of n elements; the same bits on every run.

    Args:
        n: elements of a field.
        device: where they live.
        scalars: device array that receives the sums, shape (slots,), float64.
        columns: the most sums that one pass makes.
        threads: threads of that pass; those of a flat kernel unless given.
        across: who has the other parts of the fields; None: nobody.
    """

    def __init__(
        self, n: int, device: wp.Device, scalars: wp.array[wp.float64], *, columns: int = 1, threads: int | None = None,
        across: Across | None = None,
    ) -> None:  # fmt: skip
        self.scalars, self.columns, self._across = scalars, columns, across
        self.threads = threads or Rows.flat(n, device).places
        self.block = CUDA_BLOCK if device.is_cuda else 1
        self.partials = wp.zeros(columns * self.threads, dtype=wp.float64, device=device)
        # one block of a GPU would take long over millions of partial sums: many blocks add them up first
        self._segments = CUDA_SEGMENTS if device.is_cuda and self.threads > CUDA_SEGMENTS * CUDA_BLOCK else 1
        self._folded = wp.zeros(columns * self._segments, dtype=wp.float64, device=device)

    def add_up(self, slot: int, columns: int = 1, *, launch: Launch = wp.launch) -> None:
        """Write the sums of the first columns of partial sums to scalars[slot], scalars[slot + 1], ..."""
        source, n, device = self.partials, self.threads, self.partials.device
        if device.is_cpu:  # Warp's tiles are not for several threads at a time
            given: dict[str, Any] = {"partials": source, "count": n, "scalars": self.scalars, "slot": slot}
            ADD_UP.bind(Rows.flat(columns, device), **given).launch(launch)
        else:
            if self._segments > 1:
                inputs = [source, n, self.block, self._segments, self._folded, 0]
                launch(add_up_kernel, columns * self._segments * self.block, inputs, device=device, block_dim=self.block)
                source, n = self._folded, self._segments
            inputs = [source, n, self.block, 1, self.scalars, slot]
            launch(add_up_kernel, columns * self.block, inputs, device=device, block_dim=self.block)
        if self._across is not None:
            perform(partial(_add_across, self._across, self.scalars, slice(slot, slot + columns)), launch)

    def dot(self, a: wp.array[Any], b: wp.array[Any], slot: int, *, launch: Launch = wp.launch) -> None:
        """Write the inner product a.b to scalars[slot]."""
        DOT.bind(rows_of(a), a=a, b=b, out=self.partials).launch(launch)
        self.add_up(slot, launch=launch)


class Sums(Reduction):
    """Sums that passes over the same rows make, read back by the host.

    Args:
        rows: of the passes.
        columns: the most sums that one of them makes.
        slots: of `scalars`, if more than that.
        across: who has the other parts of the fields; None: nobody.
    """

    def __init__(self, rows: Rows, columns: int = 1, *, slots: int = 0, across: Across | None = None) -> None:
        self.rows, scalars = rows, wp.zeros(max(columns, slots), dtype=wp.float64, device=rows.device)
        super().__init__(rows.size, rows.device, scalars, columns=columns, threads=rows.places, across=across)

    def of(self, declared: RowPass, slot: int = 0, **given: Any) -> np.ndarray:
        """Launch a pass; return its sums, which are in `scalars` from a slot on."""
        declared.bind(self.rows, **given, out=self.partials).launch()
        self.add_up(slot, columns=len(declared.sums))
        return self.scalars.numpy()[slot : slot + len(declared.sums)]


def _add_across(across: Across, scalars: wp.array[wp.float64], slots: slice) -> None:
    """Add what the others have summed."""
    if scalars.device.is_cpu:
        sums = scalars.numpy()[slots]
        sums[...] = across.sum(sums)
    else:
        scalars[slots].assign(across.sum(scalars[slots].numpy()))


def rows_of(field: wp.array[Any]) -> Rows:
    """Return the rows of passes over flat fields like this one."""
    return Rows.flat(field.size, field.device)


def convert(a: wp.array[Any], b: wp.array[Any]) -> None:
    """b = a, between float types."""
    if a.dtype is b.dtype:
        wp.copy(b, a)
    else:
        CONVERT.bind(rows_of(a), a=a, b=b).launch()
