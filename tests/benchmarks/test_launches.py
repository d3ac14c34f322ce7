"""Which launches are heard, and which bytes they are said to move."""

import numpy as np
import warp as wp

from warp_lcp.benchmarks import launches
from warp_lcp.benchmarks.launches import Launch, distinct, listen, stored_sizes, traffic

N = 64
FIELD = wp.array(dtype=wp.float32)


@wp.kernel(enable_backward=False, module="test.launches")
def saxpy_kernel(a: float, x: FIELD, unused: FIELD, mask: wp.array(dtype=wp.uint8), y: FIELD, out: wp.array(dtype=wp.float64), twice: bool):
    i = wp.tid()
    if mask[i] != wp.uint8(0):
        y[i] = y[i] + a * x[i]
    out[i] = wp.float64(x[i])


def saxpy(n: int = N, twice: bool = False) -> Launch:
    x, unused, y = (wp.array(np.arange(n), dtype=wp.float32, device="cpu") for _ in range(3))
    mask = wp.array(np.arange(n) % 3, dtype=wp.uint8, device="cpu")
    out = wp.zeros(n, dtype=wp.float64, device="cpu")
    return Launch(saxpy_kernel, n, [2.0, x, unused, mask, y, out, twice], wp.get_device("cpu"), 256)


def test_traffic_of_fields_read_written_both_and_neither():
    launch = saxpy()
    before = {label: a.numpy().copy() for label, a in launch.arrays.items()}
    found = traffic(launch, {N: N - 4})
    assert found.reads == {"x": 4 * 60, "mask": 60, "y": 4 * 60}
    assert found.writes == {"y": 4 * 60, "out": 8 * 60}
    assert found.bytes == 60 * (4 + 1 + 4 + 4 + 8)
    assert all(np.array_equal(a.numpy(), before[label]) for label, a in launch.arrays.items())


def test_arrays_of_one_memory_count_once():
    launch = saxpy()
    launch.arguments[2] = launch.arguments[1]
    assert "unused" not in launch.arrays


def test_names_tell_flags():
    assert saxpy().name == "launches.saxpy"
    assert saxpy(twice=True).name == "launches.saxpy twice"


def test_distinct_counts_and_drops_small_fields():
    heard = [saxpy(), saxpy(), saxpy(8), saxpy(twice=True)]
    assert [(launch.name, launch.count) for launch in distinct(heard, N)] == [("launches.saxpy", 2), ("launches.saxpy twice", 1)]


@wp.kernel(enable_backward=False, module="test.launches")
def gather_kernel(x: FIELD, index: wp.array(dtype=wp.int32), y: FIELD):
    i = wp.tid()
    y[i] = x[index[i]]


def test_kernels_that_follow_indices_are_left_out():
    x, y = (wp.zeros(N, dtype=wp.float32, device="cpu") for _ in range(2))
    index = wp.zeros(N, dtype=wp.int32, device="cpu")
    launch = Launch(gather_kernel, N, [x, index, y], wp.get_device("cpu"), 256)
    assert launch.indexed(N)
    assert not launch.indexed(N + 1)
    assert distinct([launch, saxpy()], N)[0].name == "launches.saxpy"


def test_listening(monkeypatch):
    monkeypatch.setattr(wp, "launch", wp.launch)  # put back afterwards
    launches.install()
    wrapped = wp.launch
    launches.install()
    assert wp.launch is wrapped
    launch = saxpy()
    with listen() as heard:
        wp.launch(saxpy_kernel, N, launch.arguments, device="cpu")
        command = wp.launch(saxpy_kernel, N, launch.arguments, device="cpu", record_cmd=True)
    wp.launch(saxpy_kernel, N, launch.arguments, device="cpu")
    assert [one.name for one in heard] == ["launches.saxpy"] * 2
    assert command is not None
    before = launch.arguments[4].numpy().copy()
    heard[0].run()
    assert not np.array_equal(launch.arguments[4].numpy(), before)


def test_stored_sizes():
    assert stored_sizes((4, 6, 7)) == {6 * 8 * 9: 4 * 6 * 7, 4 * 5 * 6: 2 * 3 * 4}
