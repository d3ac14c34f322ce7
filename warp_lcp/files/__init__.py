"""Atomic file writes, safe reading of untrusted files, and types of nested tables.

Tables stand in TOML and JSON files, or are made of keyword arguments. Their values are numbers,
text, dates, lists and further tables. Whoever reads a table checks the type of its values: pydantic
models those of a scene, `warp_lcp.run.folder` those of run.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

TableValue: TypeAlias = Any
"""A value of a table: a number, text, a date, a list or a table."""

Tables: TypeAlias = dict[str, TableValue]
"""Values and tables by name, to fill or change."""

TableView: TypeAlias = Mapping[str, TableValue]
"""Values and tables by name, to read."""
