"""Joined graphs of recorded stretches, in order with everything between them.

The tests run with the plug-in `emulated_cuda` only.
"""

import gc
import itertools
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_lcp.kernels import joined_graphs as module
from warp_lcp.kernels.host_array import HostArray
from warp_lcp.kernels.joined_graphs import joined
from warp_lcp.kernels.launch_graph import LaunchGraph, launch
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar

emulated = pytest.mark.skipif(
    "emulated_cuda" not in sys.modules, reason="the plugin emulated_cuda is not there"
)
HELD = re.compile(
    r"(=|partial\()\s*wp\.(launch|copy|capture_launch|capture_while|capture_if)\b(?!\()"
)
DEVICE = wp.get_device("cpu")


@wp.kernel(enable_backward=False, module="test_joined")
def affine_kernel(x: wp.array(dtype=wp.float64), factor: wp.float64, shift: wp.float64):  # type: ignore[valid-type]
    """Set x = factor x + shift; two of these do not commute."""
    i = wp.tid()
    x[i] = factor * x[i] + shift


@wp.kernel(enable_backward=False, module="test_joined")
def add_kernel(x: wp.array(dtype=wp.float64), more: wp.array(dtype=wp.float64)):  # type: ignore[valid-type]
    """Add `more` to x."""
    i = wp.tid()
    x[i] += more[i]


class StretchChain:
    """Stretches x = factor x + shift on the device, with the same on the host.

    Args:
        factors: factor of each stretch.
    """

    def __init__(self, factors: list[float]) -> None:
        self.reading = DeviceScalar(DEVICE, 3)
        self.x, self.expected, self.factors = self.reading.array, np.zeros(3), factors
        self.shifts = [Scalar() for _ in factors]
        self.stretches = [LaunchGraph(DEVICE, self._recorder(i)) for i in range(len(factors))]

    def _recorder(self, i: int) -> Callable[[], None]:
        return lambda: launch(
            affine_kernel, 3, [self.x, self.factors[i], self.shifts[i]], device=DEVICE
        )

    def take(self, i: int, shift: float) -> None:
        """Launch stretch i with a shift."""
        self.shifts[i].value = shift
        self.stretches[i].run()
        self.reading.changed()
        self.expected = self.factors[i] * self.expected + shift


@pytest.fixture
def chain(monkeypatch: pytest.MonkeyPatch) -> Iterator[StretchChain]:
    monkeypatch.setattr(LaunchGraph, "on_device", True)
    made = StretchChain([2.0, -3.0, 0.5, 1.5])
    for i in range(4):  # the first run loads kernels
        made.take(i, 1.0)
    assert made.reading.numpy().tolist() == made.expected.tolist()
    yield made
    assert module.WAITING.programs == []
    assert module.WAITING.depth == 0


def calls_of(step: Callable[[], None]) -> int:
    """Return the launches by Python in a step that has run before."""
    from benchmarks.emulated_cuda import meter

    step()
    step()
    meter.clear()
    step()
    return meter["calls"]


@emulated
def test_arrays_of_the_host_are_sent_in_order(chain: StretchChain) -> None:
    """Host arrays, sent in order.

    A stretch reads what was sent last before it, also where the same array is sent several times in
    a step. Sending is no launch.
    """
    sent = HostArray(3, wp.float64, DEVICE)
    adding = LaunchGraph(
        DEVICE, lambda: launch(add_kernel, 3, [chain.x, sent.array], device=DEVICE)
    )

    def add(value: float) -> None:
        sent.host[:] = value, 2.0 * value, -value
        sent.send()
        adding.run()
        chain.reading.changed()
        chain.expected = chain.expected + sent.host

    def step() -> None:
        with joined(DEVICE):
            chain.take(0, 0.5)
            for value in (3.0, 3.0, -7.0):  # the second time there is nothing to copy
                chain.take(1, 0.25)
                add(value + chain.expected[0] % 5)
            chain.take(2, 1.0)
        np.testing.assert_array_equal(chain.reading.numpy(), chain.expected)

    for _ in range(4):
        step()

    numbers = itertools.count(1)

    def once() -> None:
        with joined(DEVICE):
            chain.take(0, 0.5)
            add(float(next(numbers)))
            chain.take(1, 0.25)
        assert chain.reading.numpy().tolist() == chain.expected.tolist()

    assert calls_of(once) <= 2


@emulated
def test_stretches_between_readbacks_are_two_launches(chain: StretchChain) -> None:
    def step() -> None:
        with joined(DEVICE):
            for i in (0, 1, 2, 3):
                chain.take(i, chain.expected[0] + i)
            np.testing.assert_array_equal(chain.reading.numpy(), chain.expected)

    assert calls_of(step) == 2  # the first one, as the device is idle, and the others

    def apart() -> None:
        for i in (0, 1, 2, 3):
            chain.take(i, chain.expected[0] + i)

    assert calls_of(apart) == 4


@emulated
def test_a_stretch_that_comes_again_reads_its_numbers_of_each_run(chain: StretchChain) -> None:
    def step() -> None:
        with joined(DEVICE):
            for shift in (1.0, 2.0, 4.0):
                chain.take(1, shift)
                chain.take(2, shift)
        np.testing.assert_array_equal(chain.reading.numpy(), chain.expected)

    for _ in range(4):
        step()


@emulated
@pytest.mark.parametrize("seed", range(8))
def test_calls_of_warp_between_stretches_keep_their_places(chain: StretchChain, seed: int) -> None:
    rng = np.random.default_rng(700 + seed)
    other = wp.zeros(3, dtype=wp.float64, device=DEVICE)
    recorded = wp.launch(affine_kernel, 3, [chain.x, 0.25, 3.0], device=DEVICE, record_cmd=True)

    def warp_launch() -> None:
        wp.launch(affine_kernel, 3, [chain.x, 0.5, 7.0], device=DEVICE)
        chain.expected = 0.5 * chain.expected + 7.0

    def launch_again() -> None:
        recorded.launch()
        chain.expected = 0.25 * chain.expected + 3.0

    def fill() -> None:
        chain.x.fill_(5.0)
        chain.expected[:] = 5.0

    def zero() -> None:
        chain.x.zero_()
        chain.expected[:] = 0.0

    def assign() -> None:
        chain.expected = rng.integers(-4, 4, 3).astype(float)
        chain.x.assign(chain.expected)

    def copy_out() -> None:
        wp.copy(other, chain.x)
        np.testing.assert_array_equal(other.numpy(), chain.expected)

    def read() -> None:
        np.testing.assert_array_equal(chain.x.numpy(), chain.expected)

    plain = (warp_launch, launch_again, fill, zero, assign, copy_out, read)
    for sequence in (rng.integers(0, 11, 12), rng.integers(0, 11, 12)):
        for _ in range(3):  # launched one by one, captured, launched as a graph
            with joined(DEVICE):
                for what in sequence:
                    if what < 4:
                        chain.take(what, float(rng.integers(-3, 4)))
                    else:
                        plain[what - 4]()
            np.testing.assert_array_equal(chain.reading.numpy(), chain.expected)
        chain.x.assign(np.ones(3))  # numbers stay small
        chain.expected[:] = 1.0


@emulated
def test_an_error_leaves_nothing_that_waits(chain: StretchChain) -> None:
    for _ in range(3):
        with pytest.raises(RuntimeError, match="within"), joined(DEVICE):
            chain.take(0, 1.0)
            chain.take(1, 2.0)
            chain.take(2, 2.0)
            raise RuntimeError("within")
        np.testing.assert_array_equal(chain.reading.numpy(), chain.expected)


@emulated
def test_graphs_go_with_their_stretches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LaunchGraph, "on_device", True)
    module._sequences.clear()
    chain: Any = StretchChain([2.0, 3.0, 4.0])
    for _ in range(4):
        with joined(DEVICE):
            for i in range(3):
                chain.take(i, 1.0)
        chain.reading.numpy()
    assert len(module._sequences) == 1
    del chain
    gc.collect()
    assert not module._sequences


def test_no_function_of_warp_is_held_from_before_it_settles() -> None:
    """No reference to functions of Warp from before their replacement.

    A default argument or a partial would hold the original function, which ignores deferred
    launches.
    """
    held = []
    for folder in ("warp_lcp", "fluids", "granular"):
        for file in sorted((Path(__file__).parents[2] / folder).rglob("*.py")):
            if "distributed" not in file.parts:  # graphs of steps exist in one process only
                held += [
                    f"{file.name}: {line.strip()}"
                    for line in file.read_text().splitlines()
                    if HELD.search(line)
                ]
    assert held == []
