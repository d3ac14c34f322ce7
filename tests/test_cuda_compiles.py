"""Every kernel compiles for CUDA without a GPU: a machine with one must meet no surprise."""

import importlib
import pkgutil

import numpy as np
import pytest
import warp as wp

import fluids
import warp_lcp as wl
from warp_lcp.grid import transfer_kernels
from warp_lcp.multigrid import CycleSettings

ONE_LAUNCH = [CycleSettings(one_launch_cpu=4096), CycleSettings(one_launch_cpu=4096, coarsest_cpu=8)]  # as GPUs cycle
METHODS = [
    wl.MinimumMapNewton(),
    wl.MinimumMapNewton(precision="double"),
    wl.ProjectedMultigrid(),
    wl.ProjectedMultigrid(precision="double"),
    wl.ProjectedSOR(),
    *(wl.ProjectedMultigrid(precision=p, cycle=c) for p in ("mixed", "double") for c in ONE_LAUNCH),
]


def use_every_kernel():
    """Instantiate the kernels that are made on demand by solving small problems in every precision."""
    cells = np.ones((4, 4, 4), dtype=int)
    cells[-1] = wl.AIR
    face = np.full((4, 4, 5), 0.5)
    for dtype in (wp.float32, wp.float64):
        for faces in ({}, {"face_x": 2.0}, {"face_x": face}):
            problem = wl.LCP(wl.GridPoisson(cells, device="cpu", dtype=dtype, **faces), -np.ones(cells.shape))
            for solver in METHODS:
                assert wl.solve(problem, solver, stopping=wl.StoppingCriteria(rtol=1e-4))
    for real in (wp.float32, wp.float64):
        transfer_kernels.kernels(real)
    wl.solve(wl.LCP(wl.DenseOperator(np.eye(3), device="cpu"), -np.ones(3)), wl.MinimumMapNewton(precision="single"))


def test_all_kernels_compile_for_sm_80_and_sm_90(tmp_path):
    for package in (wl, fluids):
        for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            importlib.import_module(found.name)
    use_every_kernel()
    from warp._src.context import user_modules

    names = sorted(name for name, module in user_modules.items() if name.startswith(("warp_lcp", "fluids")) and module.kernels)
    assert len(names) > 15
    for name in names:
        try:
            wp.compile_aot_module(name, device=None, arch=[80, 90], module_dir=tmp_path / name, use_ptx=True)
        except (RuntimeError, OSError) as error:
            pytest.fail(f"{name} does not compile: {error}")
