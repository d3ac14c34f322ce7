"""A program for ranks: solve grid problems by PetscActiveSet, and tell how that went.

Usage: petsc_active_set_on_ranks.py. Rank 0 prints one JSON object.
"""

import json

import numpy as np
import warp as wp
from oracle_problems import FLUID, Small, small
from petsc_oracles import shared_problem, whole_field

import warp_lcp as wl
from warp_lcp.distributed.petsc_active_set import PetscActiveSet
from warp_lcp.distributed.ranks import Ranks


def told(problem, solver, **stopping):
    """Solve on the ranks; return what the result says, and x."""
    boxes, lcp = shared_problem(problem, Ranks.world())
    result = wl.solve(lcp, solver, stopping=wl.StoppingCriteria(**({"rtol": 1e-9} | stopping)))
    x = whole_field(result.x.numpy(), boxes, problem.cells.shape)
    history = [(h.step, h.linear_iterations, h.active, h.residual) for h in result.history]
    return {"status": result.status.name, "linear_iterations": result.linear_iterations, "history": history, "x": x.ravel().tolist()}


def closed(net):
    """Liquid all over a closed box without bounds, whose b has this sum: singular."""
    shape = (8, 12, 16)
    b = np.random.default_rng(733).standard_normal(shape)
    infinite = np.full(shape, np.inf)
    return Small(np.full(shape, FLUID), {}, b - b.mean() + net / b.size, -infinite, infinite)


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_ERROR
    cube, brick = small("cube", "walls"), small("brick", "boxed")
    found = {
        "cube": told(cube, PetscActiveSet()),
        "brick": told(brick, PetscActiveSet()),
        "brick, double": told(brick, PetscActiveSet(precision="double"), rtol=1e-12),
        "brick, single": told(brick, PetscActiveSet(precision="single"), rtol=1e-4),
        "plane": told(small("plane", "everywhere"), PetscActiveSet()),
        "cube, cold": told(cube, PetscActiveSet(monotone_cycles=0)),
        "cube, stopped": told(cube, PetscActiveSet(), max_iterations=3),
        "cube, few": told(cube, PetscActiveSet(max_linear_iterations=1)),
        "closed": told(closed(0.0), PetscActiveSet()),
        "closed, filled": told(closed(1.0), PetscActiveSet()),
    }
    if Ranks.world().is_root:
        print(json.dumps(found))
