"""Modules that a first solve compiles, and their flags."""

import json
import subprocess
import sys

import pytest
import warp as wp

from warp_lcp.kernels import compiler

FIRST_SOLVE = """
import json
import numpy as np
import warp_lcp as wl
from warp._src.context import user_modules

cells = np.full((16, 16, 16), wl.FLUID, np.int8)
cells[:, -2:] = wl.AIR
cells[:, :2, 3:6] = wl.SOLID
b = np.random.default_rng(0).standard_normal(cells.shape)
assert wl.solve(wl.LCP(wl.GridPoisson(cells, device="cpu"), b))
loaded = {name: module for name, module in user_modules.items() if module.execs}
launched = {name: [hook for e in module.execs.values() for hook in e.kernel_hooks] \
for name, module in loaded.items()}
print(json.dumps({
    "modules": sorted(loaded),
    "idle": [f"{m}: {k}" for m, module in loaded.items() for k in module.kernels \
if not any(h.startswith(k) for h in launched[m])],
    "flags": sorted({module.options["cpu_compiler_flags"] for module in loaded.values()}),
}))
"""


def test_a_first_default_solve_compiles_few_modules_and_no_kernel_that_it_does_not_launch():
    """First default solve: few modules, no unused kernel.

    A module costs 0.04 CPU s, a kernel 0.03 to 0.3, each set of flags a precompiled header of a
    second.
    """
    run = subprocess.run(
        [sys.executable, "-c", FIRST_SOLVE], capture_output=True, text=True, check=True
    )
    found = json.loads(run.stdout.splitlines()[-1])
    assert len(found["modules"]) <= 17, found["modules"]
    assert all(name.startswith("warp_lcp.") for name in found["modules"])
    assert not found["idle"]
    assert len(found["flags"]) == 1


@pytest.mark.parametrize(
    ("version", "inlines"),
    [("1.19.0", True), ("1.19.3", True), ("1.20.0", False), ("2.0.0", False)],
)
def test_options_of_llvm_are_given_to_versions_that_have_them(monkeypatch, version, inlines):
    monkeypatch.setattr(wp, "__version__", version)
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", None)
    flags = compiler.project_module("warp_lcp.tests.compiler").options["cpu_compiler_flags"]
    assert flags.startswith(f"-march=native {compiler.HEADER_FLAGS}")
    assert (compiler.INLINE_FIRST in flags) == inlines
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", "-O1")
    flags = compiler.project_module(f"{compiler.INLINE_LATER[0]}tests").options[
        "cpu_compiler_flags"
    ]
    assert flags == f"-O1 {compiler.HEADER_FLAGS}"
