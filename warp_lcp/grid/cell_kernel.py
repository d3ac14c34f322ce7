# mypy: ignore-errors
"""Kernel factories: make kernels of functions of one cell or row piece.

Only this module defines how threads share the cells of a `CellRange`.
"""

import ast
import inspect
import textwrap
from collections.abc import Callable
from functools import partial
from typing import Any

import warp as wp

from warp_lcp.grid.particle_loops import list_of
from warp_lcp.grid.staggered import ORDERED_KERNELS, CellRange
from warp_lcp.kernels.compiler import forward_kernel, project_module
from warp_lcp.kernels.launch_graph import Launch, call, is_recording, launch, launch_ranges

# fields
F32, F64, I8, U8 = (wp.array3d(dtype=t) for t in (wp.float32, wp.float64, wp.int8, wp.uint8))
I16, I32 = wp.array3d(dtype=wp.int16), wp.array3d(dtype=wp.int32)
INTS, POINTS = wp.array(dtype=wp.int32), wp.array(dtype=wp.vec3)  # lists
PIECE = """
own_plane, own_row, own_chunk = wp.tid()
for task in range(cells.begin, wp.max(cells.finish, cells.begin + 1)):
    pass
"""
TASK = """
plane = own_plane + task // (cells.rows * cells.chunks)
row = own_row + task // cells.chunks % cells.rows
chunk = own_chunk + task % cells.chunks
k = cells.k + plane
j = cells.j + row
first = cells.i + chunk * cells.grain
end = wp.min(first + cells.grain, cells.end)
if cells.grain == 0:
    k = cells.pieces[chunk, 0][0]
    j = cells.pieces[chunk, 0][1]
    first = cells.pieces[chunk, 1][0]
    end = cells.pieces[chunk, 1][1]
"""
LOOP = "for i in range(first, end): pass"
ELEMENTS = """
own = wp.tid()
for i in range(tasks[0] + own, wp.max(tasks[1], tasks[0] + own + 1)):
    pass
"""


@wp.func
def cell_below(axis: int, k: int, j: int, i: int):
    """Return the cell below a cell's lower face; at the array's edge the cell itself."""
    return (
        wp.max(k - wp.where(axis == 2, 1, 0), 0),
        wp.max(j - wp.where(axis == 1, 1, 0), 0),
        wp.max(i - wp.where(axis == 0, 1, 0), 0),
    )


@wp.func
def neighbor_offset(n: int, planes: int):
    """Return the offset (z, y, x) of neighbor n in the block of 3^dim cells around a cell.

    Offsets count along x first; the middle one, 4 of 9 or 13 of 27, is the cell itself.
    """
    return wp.vec3i(wp.where(planes == 2, n // 9 - 1, 0), (n // 3) % 3 - 1, n % 3 - 1)


@wp.func
def next_to(axis: int, step: int, k: int, j: int, i: int):
    """Return the cell that is `step` cells further along an axis."""
    return (
        k + wp.where(axis == 2, step, 0),
        j + wp.where(axis == 1, step, 0),
        i + wp.where(axis == 0, step, 0),
    )


@wp.func
def of_axis(axis: int, x: Any, y: Any, z: Any, k: int, j: int, i: int):
    """Return the value on a face of the component along an axis; z is null in 2-D."""
    value = x[k, j, i]
    if axis == 1:
        value = y[k, j, i]
    if axis == 2:
        value = z[k, j, i]
    return value


@wp.func
def spline(d: float):
    """Return the quadratic B-spline at a distance in cells."""
    a = wp.abs(d)
    outer = wp.max(1.5 - a, 0.0)
    return wp.where(a < 0.5, 0.75 - a * a, 0.5 * outer * outer)


@wp.func
def interpolated(field: F32, planes: int, x: float, y: float, z: float):
    """Interpolate a field linearly at grid coordinates.

    Coordinates are clamped to the array; 2-D uses the plane k = 1.
    """
    cx = wp.clamp(x, 0.0, float(field.shape[2]) - 1.001)
    cy = wp.clamp(y, 0.0, float(field.shape[1]) - 1.001)
    i = int(cx)
    j = int(cy)
    k = int(1)
    fx = cx - float(i)
    fy = cy - float(j)
    value = wp.lerp(
        wp.lerp(field[1, j, i], field[1, j, i + 1], fx),
        wp.lerp(field[1, j + 1, i], field[1, j + 1, i + 1], fx),
        fy,
    )
    if planes == 2:
        cz = wp.clamp(z, 0.0, float(field.shape[0]) - 1.001)
        k = int(cz)
        low = wp.lerp(
            wp.lerp(field[k, j, i], field[k, j, i + 1], fx),
            wp.lerp(field[k, j + 1, i], field[k, j + 1, i + 1], fx),
            fy,
        )
        k += 1
        high = wp.lerp(
            wp.lerp(field[k, j, i], field[k, j, i + 1], fx),
            wp.lerp(field[k, j + 1, i], field[k, j + 1, i + 1], fx),
            fy,
        )
        value = wp.lerp(low, high, cz - float(k - 1))
    return value


def cell_kernel(module: str, *, ordered: bool = False) -> Callable[[Callable], wp.Kernel]:
    """Return a decorator that makes a kernel(cells, ...) of a function of one cell.

    The kernel is launched by `Window.launch`; `module` is its Warp module. Parameters of the
    function without a type are set by the kernel: the cell `k, j, i`, or the piece `k, j, first,
    end` of a row, the cells first <= i < end; and `plane, row, chunk`, the number of planes, rows
    and pieces before it. The function cannot return early. With `ordered` one CPU thread visits the
    cells in order, for cells that write what others read or write.
    """

    def made(function: Callable) -> wp.Kernel:
        kernel = _kernel(function, module)
        if ordered:
            ORDERED_KERNELS.add(kernel)
        return kernel

    return made


def list_kernel(module: str) -> Callable:
    """Return a decorator for kernels(tasks, ...) of functions of a list entry.

    The kernel is launched by `launch_list`; `module` is its Warp module. The function's parameter
    without a type is the entry `i`. It cannot return early, and writes nothing that other entries
    read or write.
    """
    return lambda function: _made(function, module, ("tasks", wp.vec2i), ELEMENTS, "")


def launch_list(
    kernel: wp.Kernel,
    count: int,
    inputs: list,
    *,
    device: wp.Device,
    cost: int = 1,
    launch: Launch | None = None,
    ordered: bool = False,
) -> None:
    """Launch a kernel of `list_kernel`, or record the launch.

    A recorded launch visits as many entries as the list of one of its arrays has when it runs.

    Args:
        kernel: the kernel.
        count: number of entries.
        inputs: its arguments but for the first.
        device: device of the arrays.
        cost: work of an entry, in cells of a usual pass.
        launch: the launch function of a launch graph.
        ordered: whether several entries may write the same element.
    """
    found = (list_of(a) for a in inputs) if is_recording() else ()
    listed = next((one for one in found if one is not None), None)
    inputs, sized = [wp.vec2i(0, 0), *inputs], 0 if listed is None else listed.entries
    extent = None if listed is None else listed.rows
    launch_ranges(
        kernel,
        (count,),
        cost,
        inputs,
        device=wp.get_device(device),
        launch=launch,
        ordered=ordered,
        sized=sized,
        extent=extent,
    )


@forward_kernel(module="warp_lcp.grid.scan")
def scan_kernel(values: INTS, sums: INTS, inclusive: int):
    """Write the prefix sums of values, exclusive or inclusive."""
    total = int(0)
    for n in range(values.shape[0]):
        value = values[n]
        sums[n] = total + wp.where(inclusive != 0, value, 0)
        total += value


def scan(values: wp.array, sums: wp.array, *, inclusive: bool) -> None:
    """Launch or record prefix sums of int32 numbers; both arrays may be the same."""
    if values.device.is_cuda:
        call(partial(wp.utils.array_scan, values, sums, inclusive=inclusive))
    else:
        launch(scan_kernel, 1, [values, sums, int(inclusive)], device=values.device)


def _kernel(function: Callable, module: str) -> wp.Kernel:
    parameters = inspect.signature(function).parameters.values()
    of_a_cell = any(p.name == "i" and p.annotation is p.empty for p in parameters)
    return _made(function, module, ("cells", CellRange), PIECE, TASK + LOOP if of_a_cell else TASK)


def _made(
    function: Callable, module: str, first: tuple[str, object], loop: str, before: str
) -> wp.Kernel:
    """Make a kernel: insert the function's body into the loop over tasks.

    Warp gets the resulting source text, and hashes it.
    """
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    definition = tree.body[0]
    typed = [
        p for p in inspect.signature(function).parameters.values() if p.annotation is not p.empty
    ]
    task = ast.parse(before).body
    if task and isinstance(task[-1], ast.For):
        task[-1].body = definition.body
    else:
        task += definition.body
    opened = ast.parse(loop).body
    opened[-1].body = task
    name, kind = first
    definition.body, definition.decorator_list, definition.args.args = (
        opened,
        [],
        [ast.arg(name), *(ast.arg(p.name) for p in typed)],
    )
    function.__signature__ = inspect.Signature(
        [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD), *typed]
    )
    function.__annotations__ = {name: kind} | {p.name: p.annotation for p in typed}
    key = function.__qualname__.replace("<locals>.", "").replace(".", "__")
    return wp.Kernel(
        function, key, project_module(module), {"enable_backward": False}, source=ast.unparse(tree)
    )
