"""Launch layer: layout, bounds, sums and launches of stencil kernels.

It also fuses kernels and records them in graphs. A method supplies the computation of a cell.
"""

from warp_lcp.kernels.device_graph import DeviceGraph
from warp_lcp.kernels.fused_kernel import FusedKernel
from warp_lcp.kernels.kernel_file import KernelFile
from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.kernels.layout import PrecomputedProduct
from warp_lcp.kernels.persistent_kernel import PersistentKernel
from warp_lcp.kernels.rows import Rows
from warp_lcp.kernels.stencil_kernel import BoundKernel, StencilKernel

LaunchGraph.device_program = DeviceGraph

__all__ = [
    "BoundKernel",
    "FusedKernel",
    "KernelFile",
    "PersistentKernel",
    "PrecomputedProduct",
    "Rows",
    "StencilKernel",
]
