"""Recorded launches, with tasks of the host between them."""

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.deadline import Deadline, DeadlineReached
from warp_lcp.kernels import thread_pool as team
from warp_lcp.kernels.launch_graph import CommandBuffer, Conditional, loops_on_device, perform
from warp_lcp.kernels.vectors import ADD, Reduction, rows_of

DEVICE = wp.get_device("cpu")


class ThreefoldRanks:
    """Communicator whose other ranks have three times this rank's values."""

    def sum(self, values):
        return 4.0 * np.asarray(values)


def test_a_task_runs_between_the_launches_around_it_each_time():
    a = wp.array([1.0, 2.0, 3.0], dtype=wp.float32, device=DEVICE)
    scalars = wp.zeros(2, dtype=wp.float64, device=DEVICE)
    sums, seen, program = Reduction(3, DEVICE, scalars), [], CommandBuffer(DEVICE)
    sums.dot(a, a, 0, launch=program.launch)
    perform(lambda: seen.append(scalars.numpy()[:].copy()), program.launch)
    perform(lambda: a.assign(2.0 * a.numpy()), program.launch)
    sums.dot(a, a, 1, launch=program.launch)
    for run in range(3):
        program.run()
        assert seen[-1][0] == 14.0 * 4.0**run
        assert scalars.numpy()[1] == 14.0 * 4.0 ** (run + 1)
        a.assign(np.array([1.0, 2.0, 3.0], dtype=np.float32) * 2.0 ** (run + 1))
    assert len(seen) == 3


def test_sums_are_of_all_parts():
    a = wp.array([1.0, 2.0, 3.0], dtype=wp.float64, device=DEVICE)
    scalars = wp.full(3, 7.0, dtype=wp.float64, device=DEVICE)
    Reduction(3, DEVICE, scalars, comm=ThreefoldRanks()).dot(a, a, 1)
    assert scalars.numpy().tolist() == [7.0, 56.0, 7.0]


@wp.kernel(enable_backward=False, module="test_program")
def count_down_kernel(left: wp.array(dtype=wp.int32), odd: wp.array(dtype=wp.int32)):
    """Reduce the number of remaining runs by one."""
    left[0] = left[0] - 1
    odd[0] = left[0] % 2


@pytest.fixture(params=[1, 2, 3, 7])
def threads(request, monkeypatch):
    """Set the number of threads, and split small work too."""
    before = wl.get_threads()
    wl.set_threads(request.param)
    for module in ("thread_pool", "fused_kernel", "launch_graph"):
        monkeypatch.setattr(f"warp_lcp.kernels.{module}.CELLS", 64)
    yield request.param
    wl.set_threads(before)


def counting(left: wp.array, odd: wp.array) -> tuple[CommandBuffer, wp.array, wp.array]:
    """Return a program that adds 1 to a field in each run.

    It doubles another field after every odd number of remaining runs.
    """
    ones, a, b = (
        wp.full(5000, value, dtype=wp.float64, device=DEVICE) for value in (1.0, 0.0, 1.0)
    )
    program, double = CommandBuffer(DEVICE), CommandBuffer(DEVICE)
    ADD.bind(rows_of(a), z=ones, x=a).launch(program.launch)
    program.launch(count_down_kernel, 1, [left, odd], device=DEVICE)
    ADD.bind(rows_of(b), z=b, x=b).launch(double.launch)
    program.record(Conditional(odd, double))
    return program, a, b


@pytest.mark.every_case
@pytest.mark.cpu_form("the team is the CPU's")
@pytest.mark.parametrize("runs", [0, 1, 2, 9])
def test_a_loop_runs_while_its_condition_holds(runs, threads, monkeypatch):
    """Loop that runs while its condition holds.

    The same if native code returns every few microseconds.
    """
    left, odd = (wp.zeros(1, dtype=wp.int32, device=DEVICE) for _ in range(2))
    assert loops_on_device(DEVICE)
    program, a, b = counting(left, odd)
    for patience in (team.PATIENCE, 20_000):
        monkeypatch.setattr(team, "PATIENCE", patience)
        a.fill_(0.0)
        b.fill_(1.0)
        left.fill_(runs)
        program.run_while(left)
        assert (a.numpy() == runs).all()
        assert (b.numpy() == 2.0 ** (runs // 2)).all()
    assert program._runs == 0
    left.fill_(3)
    program.run()
    assert left.numpy()[0] == 2


@pytest.mark.cpu_form("the team is the CPU's")
def test_a_loop_ends_with_what_has_failed_in_it(threads):
    """Loop that ends with an error inside it.

    As an exchange between ranks, after which the condition may never be 0.
    """
    left, odd = (wp.zeros(1, dtype=wp.int32, device=DEVICE) for _ in range(2))
    program, a, _ = counting(left, odd)

    def fail():
        raise RuntimeError("the exchange has failed")

    program._commands[0].check = fail
    left.fill_(2_000_000_000)
    with pytest.raises(RuntimeError, match="the exchange has failed"):
        program.run_while(left)
    assert 0 < a.numpy()[0] < 1e9


@pytest.mark.cpu_form("the team is the CPU's")
def test_a_loop_ends_with_the_deadline(threads):
    left, odd = (wp.zeros(1, dtype=wp.int32, device=DEVICE) for _ in range(2))
    program, a, _ = counting(left, odd)
    left.fill_(2_000_000_000)
    with Deadline(0.05), pytest.raises(DeadlineReached):
        program.run_while(left)
    done = a.numpy()[0]
    assert 0 < done < 1e9
    left.fill_(4)
    program.run_while(left)
    assert (a.numpy() >= done + 4).all()
