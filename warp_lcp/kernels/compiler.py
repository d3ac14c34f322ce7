"""Compiler settings of the project's Warp kernels on CPUs."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

# WP_NO_BFLOAT16: no kernel here computes with bfloat16. Without it, Warp's header of all built-in
# functions is a third shorter; the first module of a process compiles that to a precompiled header.
# -fpch-instantiate-templates: templates that this header uses itself are instantiated when it is
# compiled, not again in each module. Neither changes a module's object code.
HEADER_FLAGS = "-DWP_NO_BFLOAT16= -fpch-instantiate-templates"
# LLVM inlines the functions of a module before it optimizes any, instead of optimizing a kernel
# again at each level of calls: a fifth less time for code of the same size.
INLINE_FIRST = "-mllvm=-enable-module-inliner"
# These modules do not inline first. Sums of the first four would be rounded in another order. The
# others have large functions that are called from many places, and would be four times as long.
INLINE_LATER = (
    "fluids.surface_tension",
    "fluids.viscosity",
    "warp_lcp.interior_point.",
    "warp_lcp.nonsmooth_map.",
    "fluids.wall_drag",
    "warp_lcp.grid.mesh_crossings",
    "warp_lcp.grid.barriers",
    "warp_lcp.grid.thin_walls",
)
# Warp writes functions to add structs for gradients. Functions local to the module are not
# compiled.
LOCAL_FUNCTIONS = """#undef CUDA_CALLABLE
#define CUDA_CALLABLE __attribute__((internal_linkage))
"""
# Versions of Warp with which INLINE_FIRST and LOCAL_FUNCTIONS were tested. Other versions might
# lack that option of LLVM, and then no kernel would compile, or this experimental interface.
TRIED_VERSIONS = ("1.19",)


def forward_kernel(
    *, module: wp.Module | str, **options: object
) -> Callable[[Callable[..., object]], wp.Kernel]:
    """Declare a Warp kernel without a backward pass, in a module of the project.

    Args:
        module: Warp module of the kernel, or its name; see `project_module`.
        **options: of `wp.kernel`.

    Returns:
        The decorator.
    """
    project_module(module if isinstance(module, str) else module.name)
    made: Callable[[Callable[..., object]], wp.Kernel] = wp.kernel(
        enable_backward=False, module=module, **options
    )
    return made


def project_module(name: str) -> wp.Module:
    """Return a Warp module with the project's compiler flags.

    The module is created if it does not exist. Most modules share their flags: each set of flags
    has a precompiled header of its own, which takes a second. The flags are appended to
    `wp.config.cpu_compiler_flags` as it is when a kernel of the module is declared.
    """
    flags = wp.config.cpu_compiler_flags
    words = ["-march=native" if flags is None else flags, HEADER_FLAGS]  # Warp's default
    options: dict[str, object] = {}
    if ".".join(wp.__version__.split(".")[:2]) in TRIED_VERSIONS:
        options["extra_build_options"] = wp.ModuleBuildOptions(extra_cpu_preamble=LOCAL_FUNCTIONS)
        words += [] if name.startswith(INLINE_LATER) else [INLINE_FIRST]
    wp.set_module_options({**options, "cpu_compiler_flags": " ".join(words).strip()}, module=name)
    return wp.get_module(name)
