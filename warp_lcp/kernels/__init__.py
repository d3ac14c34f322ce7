"""Rows: what owns layout, bounds, sums, waves and launches of passes over grids; a method supplies what is done to a cell."""

from warp_lcp.kernels.device_graph import DeviceGraph
from warp_lcp.kernels.fused_kernel import FusedKernel
from warp_lcp.kernels.kernel_file import KernelFile
from warp_lcp.kernels.launch_graph import LaunchGraph
from warp_lcp.kernels.layout import PrecomputedProduct, Rows
from warp_lcp.kernels.persistent_kernel import PersistentKernel
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
