"""Arrays that the host writes and kernels read."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.kernels.types import DataType, DeviceArray

if TYPE_CHECKING:
    from warp_lcp.kernels.device_graph import Upload


class HostArray:
    """An array that the host writes and kernels read.

    It is one memory on the CPU, two on a GPU.

    Args:
        count: elements, or the shape.
        dtype: of them, a Warp type or struct.
        device: where kernels read them.

    Attributes:
        host: NumPy array to write to.
        array: argument of kernels, up to date after `send`.
    """

    def __init__(self, count: int | tuple[int, ...], dtype: DataType, device: wp.Device) -> None:
        self.array: DeviceArray = wp.zeros(count, dtype=dtype, device=device)
        self._shared = wp.get_device(device).is_cpu
        self.host: np.ndarray = (
            self.array.numpy() if self._shared else np.zeros_like(self.array.numpy())
        )
        self._upload: Upload | None = None  # the copy as a node of CUDA graphs

    def send(self) -> None:
        """Bring `array` up to date.

        With graphs of steps the copy is queued among recorded stretches, see `joined_graphs.py`.
        """
        if self._shared:
            return
        if not LaunchGraph.on_device:
            self.array.assign(self.host)
            return
        if self._upload is None:
            from warp_lcp.kernels.device_graph import Upload

            self._upload = Upload(self.host, self.array)
        self._upload.run()
