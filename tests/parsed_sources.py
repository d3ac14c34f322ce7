"""Syntax trees of source files, each parsed once for all tests."""

import ast
from functools import cache
from pathlib import Path


@cache
def parsed(file: Path) -> ast.Module:
    """Return the syntax tree of a file, which must not be changed."""
    return ast.parse(file.read_text())
