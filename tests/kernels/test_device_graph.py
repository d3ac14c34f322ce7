"""Launches with arguments patched in device memory, as in CUDA graphs.

The launches run on the CPU here and are compared with NumPy.
"""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from warp_lcp.grid.cell_kernel import F32, cell_kernel, list_kernel
from warp_lcp.grid.staggered import CLEAR, Window, _RangeMemory
from warp_lcp.kernels import Rows
from warp_lcp.kernels.device_graph import DeviceGraph, NotRecordableError
from warp_lcp.kernels.launch_graph import DeviceCopy
from warp_lcp.kernels.recorded_arguments import DeviceRows, Scalar, Slot

DEVICE = wp.get_device("cpu")
SHAPE = (4, 6, 9)


@list_kernel("test_device_graph.add")
def add_kernel(i, values: wp.array(dtype=wp.float32), change: float):
    """Add a number to the entries of a list."""
    values[i] = values[i] + change


@cell_kernel("test_device_graph.mark")
def mark_kernel(k, j, i, factor: float, field: F32):
    """Add a number that identifies the cell."""
    field[k, j, i] = field[k, j, i] + factor * float(100 * k + 10 * j + i)


def boxes(seed: int, count: int) -> list[tuple[tuple[int, int, int], tuple[int, int, int]]]:
    """Return the whole grid and random boxes within it, empty ones too."""
    rng, made = np.random.default_rng(seed), [((0, 0, 0), SHAPE)]
    for _ in range(count):
        corners = np.sort([[rng.integers(0, n + 1), rng.integers(0, n + 1)] for n in SHAPE], axis=1)
        made.append((tuple(int(v) for v in corners[:, 0]), tuple(int(v) for v in corners[:, 1])))
    return made


def part(box):
    """Return the slices of a box."""
    return tuple(slice(a, b) for a, b in zip(*box, strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_a_pass_visits_the_rows_of_each_run(seed):
    field, memory = wp.ones(SHAPE, dtype=wp.float32, device=DEVICE), DeviceRows()
    program, places = DeviceGraph(DEVICE), boxes(seed, 6)
    first = Rows.box(*places[0], DEVICE, cells=1)
    memory.set_layout(first.single, places[0][0])
    program.record_pass(CLEAR[wp.float32].bind(replace(first, memory=memory), field=field))
    program.finish()
    for box in places:
        memory.set_layout(Rows.box(*box, DEVICE, cells=1).single, box[0])
        field.fill_(1.0)
        expected = np.ones(SHAPE, dtype=np.float32)
        expected[part(box)] = 0.0
        assert program.fits()
        program.run()
        np.testing.assert_array_equal(field.numpy(), expected)


@pytest.mark.parametrize("seed", range(3))
def test_cells_and_numbers_are_those_of_each_run(seed):
    field, memory, factor = (
        wp.zeros(SHAPE, dtype=wp.float32, device=DEVICE),
        _RangeMemory(),
        Scalar(),
    )
    program, places = DeviceGraph(DEVICE), boxes(seed + 10, 6)

    def move(box):
        window = Window(*box, DEVICE)
        cells = window._cells(1)
        memory.set_dim(cells, (*window.rows, cells.chunks))
        return window, cells

    window, cells = move(places[0])
    program.record_tasks(
        mark_kernel,
        (*window.rows, cells.chunks),
        [cells, factor, field],
        memory.first,
        memory.sized,
        memory,
    )
    program.finish()
    k, j, i = np.indices(SHAPE)
    for turn, box in enumerate(places):
        move(box)
        factor.value = 1.0 + turn
        field.zero_()
        expected = np.zeros(SHAPE, dtype=np.float32)
        expected[part(box)] = (factor.value * (100 * k + 10 * j + i))[part(box)]
        program.run()
        np.testing.assert_array_equal(field.numpy(), expected)


def test_a_list_may_be_replaced_and_grow():
    lists = [wp.zeros(n, dtype=wp.float32, device=DEVICE) for n in (10, 7, 12, 20)]
    memory, slot, change = DeviceRows(1.25), Slot(), Scalar(2.0)
    program = DeviceGraph(DEVICE)
    memory.set_layout(Rows.listed(10, DEVICE, 1).single)
    slot.point_to(lists[0])
    program.record_tasks(
        add_kernel, (10,), [wp.vec2i(0, 0), lists[0], change], None, memory.sized, memory
    )
    program.record(DeviceCopy(lists[3], None))
    program.finish()
    for values, number in ((lists[0], 2.0), (lists[1], -3.0), (lists[2], 4.5)):
        memory.set_layout(Rows.listed(len(values), DEVICE, 1).single)
        slot.point_to(values)
        change.value = number
        assert program.fits()
        program.run()
        np.testing.assert_array_equal(
            values.numpy(), np.full(len(values), number, dtype=np.float32)
        )
    memory.set_layout(Rows.listed(20, DEVICE, 1).single)
    assert not program.fits()  # it must be captured again


def test_unsupported_launches_are_refused_in_a_graph():
    program, array = DeviceGraph(DEVICE), wp.zeros(3, dtype=wp.float32, device=DEVICE)
    Slot().point_to(array)
    with pytest.raises(NotRecordableError, match="replaced"):
        program.record(DeviceCopy(array, None))
    with pytest.raises(NotRecordableError, match="host"):
        program.record(lambda: None)
