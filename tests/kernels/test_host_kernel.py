"""Memory of kernels for loops on the host."""

from pathlib import Path

import numpy as np

from warp_lcp.grid import motion
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.host_kernel import HostKernel

HEADER = Path(motion.__file__).parent / "headers/moving_solids.h"


def test_memory_grows_with_each_array():
    """The speed of a solid that moves by 1 m in 0.5 s is 2 m/s, with any number of indices."""
    kernel = HostKernel(KernelFile(HEADER)["warp_lcp.grid.motion.top_speed"])
    turns = np.array([np.eye(3)] * 2)
    shifts = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    box = np.array([[0.25] * 3, [0.5] * 3])
    for number in range(1, 9):
        inputs = turns, shifts, box, np.full(3, 4.0)
        reals, (speed,) = kernel.run(inputs, (np.arange(number),), count=1, parts=1, span=0.5)
        np.testing.assert_array_equal(reals[18:24], shifts.ravel())
        assert speed.tolist() == [2.0]
