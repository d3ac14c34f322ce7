"""Imports at run time: no cycles, not even by imports within functions."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from parsed_sources import inner_statements, parsed

ROOT = Path(__file__).parent.parent
PACKAGES = {
    "warp_lcp": "warp_lcp",
    "warp_lcp.fluids": "fluids",
    "warp_lcp.granular": "granular",
    "warp_lcp.benchmarks": "benchmarks",
}


def modules() -> dict[str, Path]:
    """Return the files of all modules by name."""
    found = {}
    for package, folder in PACKAGES.items():
        for path in (ROOT / folder).rglob("*.py"):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            if package == "warp_lcp" and f"warp_lcp.{parts[0]}" in PACKAGES:
                continue  # a link to one of the others
            found[".".join((package, *(parts[:-1] if parts[-1] == "__init__" else parts)))] = path
    return found


def imported(node: ast.AST, names: dict[str, Path]) -> Iterator[str]:
    """Yield the modules that a module imports at run time, with their packages."""
    for child in inner_statements(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module:
            for alias in child.names:
                yield inner if (inner := f"{child.module}.{alias.name}") in names else child.module
        else:
            yield from imported(child, names)


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one node (Tarjan 1972)."""
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(node: str) -> None:
        order[node] = lowest[node] = len(order)
        stack.append(node)
        for other in sorted(edges[node]):
            if other not in order:
                visit(other)
                lowest[node] = min(lowest[node], lowest[other])
            elif other in stack:
                lowest[node] = min(lowest[node], order[other])
        if lowest[node] == order[node]:
            place = stack.index(node)
            if len(stack) - place > 1:
                found.append(sorted(stack[place:]))
            del stack[place:]

    for node in edges:
        if node not in order:
            visit(node)
    return found


def edges_of_all() -> dict[str, set[str]]:
    """Return the imports of each module of the project, packages included."""
    names, found = modules(), {}
    for name, path in names.items():
        direct = {
            other for other in imported(parsed(path), names) if other in names and other != name
        }
        around = {
            other.rsplit(".", depth)[0]
            for other in direct
            for depth in range(1, other.count(".") + 1)
        }
        found[name] = direct | {
            package for package in around if package != name and not name.startswith(f"{package}.")
        }
    return found


def test_no_circle_of_imports():
    edges = edges_of_all()
    assert len(edges) > 400
    found = circles(edges)
    assert not found, "\n".join(
        f"{m} imports {o}"
        for circle in found
        for m in circle
        for o in sorted(edges[m] & set(circle))
    )


@pytest.mark.parametrize(
    ("edges", "expected"),
    [
        ({"a": {"b"}, "b": {"c"}, "c": set()}, []),
        ({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}, [["a", "b", "c"]]),
        ({"a": {"b", "c"}, "b": {"d"}, "c": {"d"}, "d": set()}, []),
        ({"a": {"b"}, "b": {"a"}, "c": {"d", "a"}, "d": {"c"}}, [["a", "b"], ["c", "d"]]),
    ],
)
def test_circles_are_found(edges, expected):
    assert sorted(circles(edges)) == expected


def test_imports_within_functions_count_and_those_of_types_do_not():
    names = {"a": Path(), "a.b": Path(), "a.c": Path()}
    source = (
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import a.c\ndef f():\n    "
        "from a import b\n"
    )
    assert set(imported(ast.parse(source), names)) == {"typing", "a.b"}
