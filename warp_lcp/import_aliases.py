"""Older names of modules: `import warp_lcp.qp` imports `warp_lcp.extras.qp`.

Scripts, notebooks and the README files of recorded problems use them, so they keep working. An
alias is the same module, not a copy. Type checkers know the new names only.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MODULES = {
    "warp_lcp.default": "warp_lcp.method_selection",
    "warp_lcp.distributed.petsc_matrix": "warp_lcp.extras.petsc_matrix",
    "warp_lcp.gallery.articulated_figure": "warp_lcp.contacts.articulated_figure",
    "warp_lcp.gallery.contact_models": "warp_lcp.rigid.contact_models",
    "warp_lcp.gallery.inverse_kinematics": "warp_lcp.contacts.inverse_kinematics",
    "warp_lcp.gallery.problem": "warp_lcp.host_problem",
    "warp_lcp.gallery.recorded": "warp_lcp.recorded_problem",
    "warp_lcp.gradients.jax": "warp_lcp.extras.gradients.jax",
    "warp_lcp.gradients.pytorch": "warp_lcp.extras.gradients.pytorch",
    "warp_lcp.gradients.tape": "warp_lcp.extras.gradients.tape",
    "warp_lcp.grid.solids": "warp_lcp.grid.signed_distance",
    "warp_lcp.newton": "warp_lcp.extras.newton",
    "warp_lcp.newton.bodies": "warp_lcp.extras.newton.bodies",
    "warp_lcp.newton.shapes": "warp_lcp.extras.newton.shapes",
    "warp_lcp.newton.solver": "warp_lcp.extras.newton.solver",
    "warp_lcp.problem.protocol": "warp_lcp.problem.operator_protocol",
    "warp_lcp.problem.solve": "warp_lcp.problem.solve_loop",
    "warp_lcp.problem.spare_workspace": "warp_lcp.problem.workspace_cache",
    "warp_lcp.qp": "warp_lcp.extras.qp",
    "warp_lcp.render.live": "warp_lcp.extras.live",
    "warp_lcp.render.usd": "warp_lcp.extras.export",
    "warp_lcp.render.viewer": "warp_lcp.extras.viewer",
}
"""The module that each older name stands for."""


class AliasFinder(MetaPathFinder, Loader):
    """Finder and loader of modules by their older names."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of an alias; None for all other modules."""
        return ModuleSpec(name, self) if name in MODULES else None

    def exec_module(self, module: ModuleType) -> None:
        """Import the module that has the name today, and put it in the place of `module`."""
        sys.modules[module.__name__] = import_module(MODULES[module.__name__])


def install_aliases() -> None:
    """Add the finder to this process, before those that search folders.

    These would load submodules of an alias a second time, under their older names.
    """
    if not any(isinstance(finder, AliasFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, AliasFinder())
