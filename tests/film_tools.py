"""Programs that open files of runs: Blender as a module, and the OpenVDB that comes with it.

Neither is in the extra `dev`: Blender has 374 MB.
"""

import importlib
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

NO_BLENDER = "Blender is not installed (pip install bpy 'numpy<2')"


def openvdb() -> ModuleType:
    """Return OpenVDB's module: Debian's python3-openvdb, or that of Blender."""
    for name in ("openvdb", "pyopenvdb"):
        if find_spec(name) is not None:
            return importlib.import_module(name)
    blender = find_spec("bpy")
    if blender is None or blender.origin is None:
        pytest.skip("neither OpenVDB (apt install python3-openvdb) nor Blender is installed")
    found = list(Path(blender.origin).parents[0].glob("**/site-packages/openvdb.*.so"))
    if not found:
        pytest.skip("this Blender has no OpenVDB for Python")
    importlib.import_module("bpy")  # loads the libraries
    sys.path.append(str(found[0].parent))
    try:
        return importlib.import_module("openvdb")
    finally:
        sys.path.remove(str(found[0].parent))


def blender(program: str, *arguments: object) -> str:
    """Return what a program prints that imports `bpy`, in a process of its own."""
    if find_spec("bpy") is None:
        pytest.skip(NO_BLENDER)
    command = [sys.executable, "-c", program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
