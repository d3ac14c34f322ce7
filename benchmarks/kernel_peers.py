# mypy: ignore-errors
"""Peers of the 7-point product: a plain Warp kernel and Numba."""

from collections.abc import Callable

import numpy as np
import warp as wp

from warp_lcp.benchmarks.harness.machine import present

f32_3d, u8_3d = wp.array3d(dtype=wp.float32), wp.array3d(dtype=wp.uint8)


@wp.kernel(enable_backward=False, module="warp_lcp.benchmarks.plain")
def plain_kernel(d: u8_3d, x: f32_3d, y: f32_3d):
    """Evaluate y = A x with d open faces of a cell, one thread per cell.

    Cells without an unknown have d = 0 and get y = 0.
    """
    i, j, k = wp.tid()
    i += 1
    j += 1
    k += 1
    v = float(0.0)
    if d[i, j, k] != wp.uint8(0):
        v = float(d[i, j, k]) * x[i, j, k]
        v -= (
            x[i - 1, j, k]
            + x[i + 1, j, k]
            + x[i, j - 1, k]
            + x[i, j + 1, k]
            + x[i, j, k - 1]
            + x[i, j, k + 1]
        )
    y[i, j, k] = v


def plain_product(d: wp.array, x: wp.array, y: wp.array, device: str) -> Callable[[], None]:
    """Return the plain Warp product on padded fields (nz + 2, ny + 2, nx + 2)."""
    n = [s - 2 for s in x.shape]

    def run() -> None:
        wp.launch(plain_kernel, n, [d, x, y], device=device)
        wp.synchronize_device(device)

    return run


def numba_products(d: np.ndarray, x: np.ndarray, y: np.ndarray) -> dict[str, Callable[[], None]]:
    """Return Numba's products on padded fields; {} where Numba is missing.

    One has the same stencil, one a constant diagonal of 6.
    """
    if not present("numba"):
        return {}
    import numba

    @numba.njit(fastmath=True)
    def masked(d: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
        for i in range(1, x.shape[0] - 1):
            for j in range(1, x.shape[1] - 1):
                for k in range(1, x.shape[2] - 1):
                    e = np.float32(d[i, j, k])
                    v = e * x[i, j, k] - (
                        x[i - 1, j, k]
                        + x[i + 1, j, k]
                        + x[i, j - 1, k]
                        + x[i, j + 1, k]
                        + x[i, j, k - 1]
                        + x[i, j, k + 1]
                    )
                    y[i, j, k] = v if e != 0 else np.float32(0)

    @numba.njit(fastmath=True)
    def constant(x: np.ndarray, y: np.ndarray) -> None:
        for i in range(1, x.shape[0] - 1):
            for j in range(1, x.shape[1] - 1):
                for k in range(1, x.shape[2] - 1):
                    y[i, j, k] = np.float32(6) * x[i, j, k] - (
                        x[i - 1, j, k]
                        + x[i + 1, j, k]
                        + x[i, j - 1, k]
                        + x[i, j + 1, k]
                        + x[i, j, k - 1]
                        + x[i, j, k + 1]
                    )

    return {
        "Numba product": lambda: masked(d, x, y),
        "Numba product, constant diagonal": lambda: constant(x, y),
    }
