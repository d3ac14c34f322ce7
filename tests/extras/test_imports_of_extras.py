"""Core and simulators meet no extras; extras use no private names; older names of modules work."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from warp_lcp.import_aliases import MODULES

ROOT = Path(__file__).parents[2]
SOURCES = sorted(
    path for folder in ("extras", "gallery") for path in (ROOT / "warp_lcp" / folder).rglob("*.py")
)


def private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def private_names(tree: ast.Module) -> list[str]:
    """Return the private names of other modules and objects that a module uses."""
    imported = [
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if private(alias.name)
    ]
    attributes = [
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and private(node.attr)
        and not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"))
    ]
    return imported + attributes


def test_private_names_are_found():
    tree = ast.parse("from a import _b, c\nself._x = c._y\nc.__name__")
    assert private_names(tree) == ["_b", "_y"]


def test_extras_and_demonstrations_use_no_private_names():
    assert len(SOURCES) > 25
    found = {
        str(path): names
        for path in SOURCES
        if (names := private_names(ast.parse(path.read_text())))
    }
    assert found == {}


def test_solvers_simulators_and_runs_load_no_extras():
    """Modules of a new process; the extra `qp` does not load `qpsolvers` either."""
    code = (
        "import sys, warp_lcp.run.api, warp_lcp.render.render, warp_lcp.distributed;"
        "from warp_lcp.scene.scene_file import installed_simulators as found;"
        "assert len(found()) == 3;"
        "print(*[m for m in sys.modules if m.startswith(('warp_lcp.extras', 'warp_lcp.gallery'))]);"
        "import warp_lcp.extras.qp;"
        "print(*{'qpsolvers'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("older", MODULES)
def test_older_names_are_the_same_modules(older):
    for library in ("newton", "torch", "jax"):
        if library in older:
            pytest.importorskip(library, reason=f"{library} is missing")
    module = importlib.import_module(older)
    assert module is importlib.import_module(MODULES[older])
    assert module.__name__ == MODULES[older]
    package, _, name = older.rpartition(".")
    assert getattr(importlib.import_module(package), name) is module


def test_petsc_objects_have_their_documented_name():
    from warp_lcp import distributed
    from warp_lcp.extras.petsc_matrix import PetscGrid

    assert distributed.PetscGrid is PetscGrid
    with pytest.raises(AttributeError, match="has no attribute 'Petsc'"):
        distributed.Petsc  # noqa: B018


def test_other_names_are_not_found():
    with pytest.raises(ModuleNotFoundError, match="qpp"):
        importlib.import_module("warp_lcp.qpp")
