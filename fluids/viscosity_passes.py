"""Kernels of the viscous solve, see `fluids.viscosity`."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from warp_lcp.kernels import KernelFile, StencilKernel
from warp_lcp.material.boundary_kernels import RELEASED
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

CLOSE = 1e-3  # cells: a face this near to a wall, or behind it, has the wall's velocity
THETA = 0.02  # cells: the shortest link to a wall
ALIKE = 1.001  # viscosities within this ratio count as equal
# Edges of which less is filled have no stress. Two faces of air without mass that only such an edge
# couples would have a velocity that its weight hardly determines.
SLIVER = 0.01
CORE = 1e-3  # relative difference below which diagonals count as equal
# Change of the distance from face to face [cells] above which the wall is perpendicular to the
# axis.
ALONG = 0.95
KINDS = {"AIR": AIR, "FLUID": FLUID, "SOLID": SOLID, "RELEASED": RELEASED}
LIMITS = {"CLOSE": CLOSE, "THETA": THETA, "ALONG": ALONG, "ALIKE": ALIKE, "SLIVER": SLIVER}
KERNELS = KernelFile(Path(__file__).parent / "headers/viscosity.h", KINDS | LIMITS)
LEVELS = KernelFile(Path(__file__).parent / "headers/viscosity_multigrid.h", {"ALIKE": CORE})


@dataclass(frozen=True)
class ViscousKernels:
    """Kernels of the viscous solve; the declarations in the headers explain them."""

    distance: StencilKernel
    weights: StencilKernel
    diagonal: StencilKernel
    force: StencilKernel
    links: StencilKernel
    cover: StencilKernel
    add: StencilKernel
    sum: StencilKernel
    span: StencilKernel
    sweep: StencilKernel
    product: StencilKernel
    residual: StencilKernel
    average: StencilKernel
    close: StencilKernel
    coarse_diagonal: StencilKernel
    normalize: StencilKernel
    prolong: StencilKernel
    restrict: StencilKernel


@functools.cache
def viscous_passes(
    dimension: int,
    cut: bool = False,
    ghost: bool = False,
    moving: bool = False,
    varies: bool = False,
    thin: bool = False,
    bodies: bool = False,
) -> ViscousKernels:
    """Return the kernels of the viscous solve for a dimension.

    The other arguments select variants of the kernels that read walls and surface.

    Args:
        dimension: 2 or 3.
        cut: whether solids cut cells.
        ghost: whether the free surface lies between cells.
        moving: whether solids have velocities.
        varies: whether viscosities differ.
        thin: whether there are solids thinner than cells.
        bodies: whether there are rigid bodies.
    """
    area, deep = f"fluids.viscosity_{dimension}d", dimension == 3
    walls, flags = (
        "_cut" * cut + "_ghost" * ghost + "_moving" * moving,
        {"CUT": cut, "GHOST": ghost, "MOVING": moving},
    )

    def near(name: str, apart: str = "", **more: bool) -> StencilKernel:
        return KERNELS.kernel(
            f"fluids.viscosity.{name}", module=area + walls + apart, constants=flags | more
        )

    def plain(name: str) -> StencilKernel:
        return KERNELS.kernel(f"fluids.viscosity.{name}", module=area)

    def level(name: str, apart: str = "", **constants: bool) -> StencilKernel:
        return LEVELS.kernel(f"fluids.viscosity.{name}", module=area + apart, constants=constants)

    return ViscousKernels(
        distance=near("distance"),
        weights=near(
            "weights", "_varies" * varies + "_bodies" * bodies, VARIES=varies, BODIES=bodies
        ),
        diagonal=near("diagonal", "_thin" * thin, THIN=thin),
        force=near("force", "_thin" * thin, THIN=thin),
        links=near("links"),
        cover=near("cover"),
        add=plain("add"),
        sum=plain("sum"),
        span=level("span"),
        sweep=level("sweep", DEPTH=deep),
        product=level("apply", RESIDUAL=False, DEPTH=deep),
        residual=level("apply", "_residual", RESIDUAL=True, DEPTH=deep),
        average=level("average"),
        close=level("close"),
        coarse_diagonal=level("coarse_diagonal"),
        normalize=level("prolong", "_norm", NORM=True),
        prolong=level("prolong", NORM=False),
        restrict=level("restrict"),
    )
