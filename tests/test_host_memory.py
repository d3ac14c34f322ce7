"""Writes to the result of `.numpy()`: each has a reason.

It is the array's memory on the CPU and a copy on CUDA.
"""

import ast
from pathlib import Path

import warp_lcp
from parsed_sources import parsed, statements

ROOT = Path(warp_lcp.__file__).parent
VIEWS = ("reshape", "ravel", "view", "T")
WRITES = {  # function: why it may
    "kernels/fields.py:copy": "sparse fields are the CPU's",
    "kernels/fields.py:unload": "sparse fields are the CPU's",
    "kernels/vectors.py:_sum_over_ranks": "on the CPU only; assigned on CUDA",
    "solvers/staggering.py:accept": "assigned afterwards",
    "subproblems/device_iteration.py:run": "on the CPU only, where the beginning is recorded",
    "subproblems/residual_and_active_set.py:set": "on the CPU only; filled on CUDA",
}


def is_view(node: ast.expr) -> bool:
    """Return whether an expression may be memory of a Warp array.

    `.numpy()`, below subscripts and calls that make views.
    """
    while True:
        call = isinstance(node, ast.Call)
        inner = node.func if isinstance(node, ast.Call) else node
        if call and isinstance(inner, ast.Attribute) and inner.attr == "numpy":
            return True
        if not isinstance(inner, ast.Subscript) and not (
            isinstance(inner, ast.Attribute) and inner.attr in VIEWS
        ):
            return False
        node = inner.value


def pairs(node: ast.AST) -> list[tuple[ast.expr, ast.expr]]:
    """Return the targets of an assignment with their values, tuples item by item."""
    if isinstance(node, ast.AugAssign):
        return [(node.target, node.value)]
    if not isinstance(node, ast.Assign):
        return []
    found: list[tuple[ast.expr, ast.expr]] = []
    for target in node.targets:
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            found += zip(target.elts, node.value.elts, strict=False)
        else:
            found.append((target, node.value))
    return found


def writes(function: ast.FunctionDef) -> bool:
    """Return whether a function writes to a result of `.numpy()`."""
    assigned = [
        (node, target, value) for node in statements(function) for target, value in pairs(node)
    ]
    views = {
        t.id
        for node, t, value in assigned
        if isinstance(node, ast.Assign) and isinstance(t, ast.Name) and is_view(value)
    }
    for node, target, _ in assigned:
        base = target
        while isinstance(base, ast.Subscript):
            base = base.value
        named = isinstance(base, ast.Name) and base.id in views
        if (isinstance(target, ast.Subscript) and (named or is_view(target))) or (
            isinstance(node, ast.AugAssign) and named
        ):
            return True
    return False


def test_no_code_writes_to_a_host_copy_of_device_memory() -> None:
    found = set()
    for path in ROOT.rglob("*.py"):
        if "benchmarks" not in path.parts:
            functions = [f for f in statements(parsed(path)) if isinstance(f, ast.FunctionDef)]
            found |= {f"{path.relative_to(ROOT)}:{f.name}" for f in functions if writes(f)}
    assert found == set(WRITES)


def test_the_guard_sees_writes() -> None:
    for line in (
        "x.numpy()[0] = 1",
        "a = x.numpy().reshape(2, 2)[1:]; a[0] = 1",
        "a = x.numpy(); a += 1",
        "a, b = x, y.numpy(); b[0] *= 2",
    ):
        function = ast.parse(f"def f(x, y):\n    {line}").body[0]
        assert isinstance(function, ast.FunctionDef)
        assert writes(function), line
    harmless = ast.parse(
        "def f(x):\n    a = x.numpy().copy(); a[0] = 1; b = x.numpy() + 1; b += 1; c = x.numpy(); "
        "c = c + 1"
    ).body[0]
    assert isinstance(harmless, ast.FunctionDef)
    assert not writes(harmless)
