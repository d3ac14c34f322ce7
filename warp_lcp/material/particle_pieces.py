"""State of a simulation as a whole and in pieces, one piece a rank."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from warp_lcp.grid.particle_ids import BIRTH_TIMES, FIRST_IDS, ID
from warp_lcp.material.particle_redistribution import STATE

# One rank's piece of a simulation's state. The last axes of fields of cells are z, y, x.
Piece = Mapping[str, np.ndarray]

ALIKE = ("bodies", "body_contacts")  # tables that are the same on all ranks
IDENTITY = (ID, FIRST_IDS, BIRTH_TIMES)  # arrays that a state has with `output.ids`
# Arrays of passive particles, which have no places: their numbers differ from the material's.
PASSIVE = ("whitewater_position", "whitewater_velocity", "whitewater_state")
LATER = {STATE: np.float64}  # arrays that exist after the first density correction


def fields_of(state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the entries of a state that are fields of cells."""
    return {name: values for name, values in state.items() if np.ndim(values) >= 3}


def passive_arrays(
    state: Mapping[str, np.ndarray], names: Sequence[str] = PASSIVE
) -> dict[str, np.ndarray]:
    """Return the arrays of passive particles in a state or a piece, checked.

    Args:
        state: the arrays by name.
        names: those of the particles, float32 of shape (n, 3).

    Raises:
        ValueError: one is missing, or not float32 of the same shape (n, 3), or not finite.
    """
    missing = sorted(set(names) - set(state))
    if missing:
        raise ValueError(f"the state lacks {', '.join(missing)}: it does not belong to this scene")
    arrays = {name: np.asarray(state[name]) for name in names}
    shape = (len(arrays[names[0]]), 3)
    for name, values in arrays.items():
        if values.shape != shape or values.dtype != np.float32:
            raise ValueError(
                f"the state's {name} is {values.dtype}{values.shape}: expected float32{shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"the state's {name} has values that are not finite")
    return arrays


def piece_of(state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the state of a one-process simulation as the piece of a single rank.

    Raises:
        ValueError: it is not the state of particles.
    """
    missing = sorted({"signature", "position", "cells"} - state.keys())
    if missing:
        raise ValueError(f"the state lacks {', '.join(missing)}: it does not belong to this scene")
    counts = np.asarray(state["signature"][:3], dtype=np.int64)
    cells = {
        name: np.ascontiguousarray(field[..., 1:-1, 1:-1, 1:-1])
        for name, field in fields_of(state).items()
    }
    place = np.arange(len(state["position"]), dtype=np.int64)
    return {
        **state,
        **cells,
        "counts": counts,
        "box": np.array([np.zeros(3, dtype=np.int64), counts]),
        "place": place,
    }


def state_of(pieces: Sequence[Piece], like: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Merge the pieces of all ranks to the state of a one-process simulation.

    Args:
        pieces: pieces of all ranks.
        like: a state of the same scene in one process, which gives names, types and what lies
            around the domain.

    Raises:
        ValueError: the pieces do not cover the domain, or lack something.
    """
    missing = sorted(
        {
            name
            for piece in pieces
            for name in (*like, "place", "box")
            if name not in (*piece, *LATER, *IDENTITY)
        }
    )
    if missing or not pieces:
        raise ValueError(
            f"the pieces lack {', '.join(missing) or 'everything'}: they do not belong to this "
            "scene"
        )
    order = np.argsort(np.concatenate([piece["place"] for piece in pieces]), kind="stable")
    later = {
        name: np.zeros(like["cells"].shape, dtype)
        for name, dtype in LATER.items()
        if all(name in piece for piece in pieces)
    }
    absent = {name for name in IDENTITY if any(name not in piece for piece in pieces)}
    like = {name: v for name, v in like.items() if name not in {*LATER, *absent}} | later
    state, covered, fields = {}, 0, fields_of(like)
    for name, values in like.items():
        if name in fields:
            state[name] = np.array(values)
        elif name in PASSIVE:
            state[name] = np.concatenate([piece[name] for piece in pieces])
        elif name == ID or (values.ndim == 2 and name not in ALIKE):
            state[name] = np.concatenate([piece[name] for piece in pieces])[order]
        else:
            state[name] = np.asarray(pieces[0][name])
    for piece in pieces:
        low, high = piece["box"] + 1  # a ring of cells lies around the domain
        covered += int(np.prod(high - low))
        for name in fields:
            z, y, x = (slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
            state[name][..., z, y, x] = piece[name]
    if covered != np.prod(pieces[0]["counts"]):
        raise ValueError("the pieces do not cover the domain: some are missing or duplicated")
    return state
