"""Recorded launches, with tasks of the host between them."""

import numpy as np
import warp as wp

from warp_lcp.rows.program import Program, perform
from warp_lcp.rows.vectors import Reduction

DEVICE = wp.get_device("cpu")


class Others:
    """Somebody who has three times as much of everything."""

    def sum(self, values):
        return 4.0 * np.asarray(values)


def test_a_task_runs_between_the_launches_around_it_each_time():
    a = wp.array([1.0, 2.0, 3.0], dtype=wp.float32, device=DEVICE)
    scalars = wp.zeros(2, dtype=wp.float64, device=DEVICE)
    sums, seen, program = Reduction(3, DEVICE, scalars), [], Program(DEVICE)
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
    Reduction(3, DEVICE, scalars, across=Others()).dot(a, a, 1)
    assert scalars.numpy().tolist() == [7.0, 56.0, 7.0]
