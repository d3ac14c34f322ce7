"""Rows: what owns layout, bounds, sums, waves and launches of passes over grids; a method supplies what is done to a cell."""

from warp_lcp.rows.device_graph import DeviceProgram
from warp_lcp.rows.kernel_file import KernelFile
from warp_lcp.rows.layout import Known, Rows
from warp_lcp.rows.program import LaunchGraph
from warp_lcp.rows.row_pass import Bound, RowPass
from warp_lcp.rows.sequence import Sequence
from warp_lcp.rows.wave import Wave

LaunchGraph.device_program = DeviceProgram

__all__ = ["Bound", "KernelFile", "Known", "RowPass", "Rows", "Sequence", "Wave"]
