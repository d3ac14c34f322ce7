"""How Warp's compiler is called for the project's kernels on CPUs."""

from __future__ import annotations

from typing import Any

import warp as wp

# WP_NO_BFLOAT16: no kernel here computes with bfloat16, and Warp's header of all built-in functions,
# which the first module of a process compiles to a precompiled header, is a third shorter without it.
# -fpch-instantiate-templates: templates that this header uses itself are instantiated when it is
# compiled, not again in each module. Neither changes a module's object code.
HEADER_FLAGS = "-DWP_NO_BFLOAT16= -fpch-instantiate-templates"


def forward_kernel(*, module: str, **options: Any) -> Any:
    """Declare a Warp kernel without a backward pass, in a module of the project.

    Args:
        module: Warp module of the kernel, see `project_module`.
        **options: of `wp.kernel`.

    Returns:
        The decorator.
    """
    project_module(module)
    return wp.kernel(enable_backward=False, module=module, **options)


def project_module(name: str) -> Any:
    """Return a Warp module, made if need be, that is compiled with `HEADER_FLAGS`.

    All modules of the project are: there is one precompiled header for each set of flags. To those
    flags, `wp.config.cpu_compiler_flags` is added as it is when a kernel of the module is declared.
    """
    flags = wp.config.cpu_compiler_flags
    flags = "-march=native" if flags is None else flags  # what Warp takes for None
    module = wp.get_module(name)
    module.options["cpu_compiler_flags"] = f"{flags} {HEADER_FLAGS}".strip()
    return module
