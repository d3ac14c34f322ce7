# mypy: ignore-errors
"""Kernels that are written for a cell, or for a piece of a row: how threads share the cells of a `CellRange` stands here alone."""

import ast
import inspect
import textwrap
from collections.abc import Callable

import warp as wp

from warp_lcp.grid.staggered import CellRange

PIECE = """
plane_, row_, chunk_ = wp.tid()
k = cells.k + plane_
j = cells.j + row_
first = cells.i + chunk_ * cells.grain
end = wp.min(first + cells.grain, cells.end)
"""
LOOP = "for i in range(first, end): pass"


def each_cell(module: str) -> Callable[[Callable], wp.Kernel]:
    """Return a decorator that makes a kernel(cells, ...) of a Warp function (k, j, i, ...) of one cell, which does not return."""
    return lambda function: _kernel(function, module, ["k", "j", "i"], loop=True)


def each_piece(module: str) -> Callable[[Callable], wp.Kernel]:
    """Return a decorator that makes a kernel(cells, ...) of a Warp function (k, j, first, end, ...) of cells first <= i < end of a row."""
    return lambda function: _kernel(function, module, ["k", "j", "first", "end"], loop=False)


def _kernel(function: Callable, module: str, own: list[str], *, loop: bool) -> wp.Kernel:
    """Put the function's body behind what opens a piece. Warp is given the text that results, which it hashes."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    made, parameters = tree.body[0], list(inspect.signature(function).parameters.values())
    if [p.name for p in parameters[: len(own)]] != own:
        raise TypeError(f"{function.__name__} begins with {[p.name for p in parameters[: len(own)]]}, not with {own}")
    head, body = ast.parse(PIECE + LOOP * loop).body, made.body
    if loop:
        head[-1].body, body = body, []
    rest = parameters[len(own) :]
    made.body, made.decorator_list, made.args.args = head + body, [], [ast.arg("cells"), *(ast.arg(p.name) for p in rest)]
    function.__signature__ = inspect.Signature([inspect.Parameter("cells", inspect.Parameter.POSITIONAL_OR_KEYWORD), *rest])
    function.__annotations__ = {"cells": CellRange} | {p.name: p.annotation for p in rest}
    key, options = function.__qualname__.replace("<locals>.", "").replace(".", "__"), {"enable_backward": False}
    return wp.Kernel(function, key=key, module=wp.get_module(module), options=options, source=ast.unparse(tree))
