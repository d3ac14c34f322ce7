"""Kernels of active sets: classification, right-hand sides, projected steps."""

from __future__ import annotations

from pathlib import Path

from warp_lcp.kernels import KernelFile, Rows
from warp_lcp.kernels.layout import BoundOperands
from warp_lcp.kernels.types import DeviceArray

KERNELS = KernelFile(Path(__file__).parent / "headers/reduced_systems.h")
CLASSIFY = KERNELS["active_set.classify"]
ALL_FREE = KERNELS["active_set.all_free"]
ON_FREE = KERNELS["active_set.on_free"]
STEP = KERNELS["active_set.step"]
SHIFT = KERNELS["principal_system.shift"]
MASK = KERNELS["principal_system.mask"]
DIVIDE = KERNELS["principal_system.divide"]


def projected_move(
    rows: Rows,
    bounds: BoundOperands,
    x: DeviceArray,
    along: DeviceArray | None,
    length: float,
    to: DeviceArray,
    *,
    z: DeviceArray | None = None,
    beta: float = 0.0,
    saved_x: DeviceArray | None = None,
    guarded: bool = True,
) -> None:
    """Set `to` = clip(x + length along, l, u) where the direction is not 0.

    With `z`, the direction z + beta along first replaces `along`. `saved_x` receives x. If
    `guarded`, an x whose step is not finite stays unchanged. See `reduced_systems.h`.
    """
    STEP.bind(
        rows,
        bounds=bounds,
        x=x,
        z=z,
        along=along,
        to=to,
        saved_x=saved_x,
        beta=beta,
        step=length,
        guarded=guarded,
    ).launch()
