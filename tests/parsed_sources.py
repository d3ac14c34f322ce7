"""Syntax trees of source files, each parsed once for all tests."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

CLASS = re.compile(r"^[ \t]*class (\w+)[(:]", re.MULTILINE)


@cache
def parsed(file: Path) -> ast.Module:
    """Return the syntax tree of a file, which must not be changed."""
    return ast.parse(file.read_text())


def inner_statements(node: ast.AST) -> list[ast.AST]:
    """Return the statements, handlers and cases directly below a module or a statement."""
    return [
        inner
        for field in ("body", "orelse", "finalbody", "handlers", "cases")
        for inner in getattr(node, field, [])
    ]


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements below a node, without the expressions in them: 10 times fewer nodes."""
    for inner in inner_statements(node):
        yield inner
        yield from statements(inner)


def functions(file: Path) -> Iterator[tuple[str, int]]:
    """Yield the name and the line of each function of a file, nested ones included."""
    for statement in statements(parsed(file)):
        if isinstance(statement, ast.FunctionDef):
            yield statement.name, statement.lineno


def classes(file: Path) -> Iterator[tuple[str, int]]:
    """Yield the name and the line of each class of a file, nested ones included.

    Classes in texts of programs count, too: the file is not parsed, which takes 40 times as long.
    """
    text = file.read_text()
    for found in CLASS.finditer(text):
        yield found[1], text.count("\n", 0, found.start(1)) + 1
