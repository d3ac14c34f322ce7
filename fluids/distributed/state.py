"""The state of liquid that ranks share, in pieces that any number of ranks can go on from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.distributed.decomposition import CellBox
from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.material.particle_rearrangement import STATE

Piece = Mapping[str, np.ndarray]  # what one rank has of a simulation's state

CELLS = {"pressure": np.float64, "cells": np.int8, "contact": np.uint8}
LATER = {STATE: np.float64}  # there once particles have been moved apart
NUMBERS = ("time", "step_count", "last_dt", "pressure_dt", "time_error", "signature", "counts")


def piece_of(state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the state of a simulation in one process as the piece of a rank that has everything.

    Raises:
        ValueError: it is not the state of a liquid.
    """
    missing = sorted({"signature", "position", *CELLS} - state.keys())
    if missing:
        raise ValueError(f"the state lacks {', '.join(missing)}: it does not belong to this scene")
    counts = np.asarray(state["signature"][:3], dtype=np.int64)
    cells = {name: np.ascontiguousarray(state[name][1:-1, 1:-1, 1:-1]) for name in _cells([state])}
    place = np.arange(len(state["position"]), dtype=np.int64)
    return {**state, **cells, "counts": counts, "box": np.array([np.zeros(3, dtype=np.int64), counts]), "place": place}


def state_of(pieces: Sequence[Piece], like: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the pieces of all ranks as the state of a simulation in one process.

    Args:
        pieces: of all ranks.
        like: a state of the same scene in one process, which gives names, types and what lies around the domain.

    Raises:
        ValueError: the pieces do not cover the domain, or lack something.
    """
    missing = sorted({name for piece in pieces for name in (*like, "place", "box") if name not in (*piece, *LATER)})
    if missing or not pieces:
        raise ValueError(f"the pieces lack {', '.join(missing) or 'everything'}: they do not belong to this scene")
    order = np.argsort(np.concatenate([piece["place"] for piece in pieces]), kind="stable")
    whole, covered, fields = {}, 0, _cells(pieces)
    like = {name: values for name, values in like.items() if name not in LATER} | {
        name: np.zeros(like["pressure"].shape, dtype) for name, dtype in LATER.items() if name in fields
    }
    for name, values in like.items():
        if name in fields:
            whole[name] = np.array(values)
        elif values.ndim == 2:
            whole[name] = np.concatenate([piece[name] for piece in pieces])[order]
        else:
            whole[name] = np.asarray(pieces[0][name])
    for piece in pieces:
        low, high = piece["box"] + 1  # a ring of cells lies around the domain
        covered += int(np.prod(high - low))
        for name in fields:
            whole[name][tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))] = piece[name]
    if covered != np.prod(pieces[0]["counts"]):
        raise ValueError("the pieces do not cover the domain: some are missing, or twice there")
    return whole


def take_pieces(
    part: Subdomain, particles: Sequence[str], signature: np.ndarray, pieces: Sequence[Piece], base: wp.array | None
) -> tuple[Piece, Piece, Piece]:
    """Take from pieces what lies in this rank's box; collective.

    Args:
        part: where this rank works.
        particles: names of the particles' arrays, float32 of shape (n, 3).
        signature: numbers that tell this scene's state from another's.
        pieces: of all ranks of a run.
        base: int8, SOLID in cells without liquid, of the part; None: solids move.

    Returns:
        By name: the particles with their `place`, the cells of this rank's box, shape (nz, ny, nx), and numbers that all pieces have alike.

    Raises:
        ValueError: the pieces do not belong to this scene, or do not cover the domain; on all ranks.
    """
    with part.decomposition.collective.led():
        numbers = _numbers(pieces, [*particles, "place", *CELLS, "box"], signature)
        cells = {name: np.zeros(part.box.counts[::-1], dtype=dtype) for name, dtype in _cells(pieces).items()}
        own: Piece = {name: np.empty((0, 3), dtype=np.float32) for name in particles} | {"place": np.empty(0, dtype=np.int64)}
        covered, found = 0, [own]
        for piece in pieces:
            box = CellBox.of(*piece["box"])
            shared = box.common(part.box)
            covered += shared.cells
            for name, values in cells.items() if shared.cells else ():
                values[shared.moved(part.box.low, -1).slices] = piece[name][shared.moved(box.low, -1).slices]
            if box.grown(part.layers).common(part.box).cells:  # particles move on to their rank when the next step begins
                inside = _in_box(part, piece)
                found.append({name: np.asarray(piece[name])[inside] for name in own})
        own = {name: np.ascontiguousarray(np.concatenate([p[name] for p in found])) for name in own}
        if covered != part.box.cells:
            raise ValueError("the pieces do not cover the domain: some are missing, or twice there")
        if any(not np.isfinite(values).all() for values in (*own.values(), cells["pressure"])):
            raise ValueError("the pieces hold values that are not finite")
        if base is not None and not np.array_equal(cells["cells"] == wl.SOLID, part.box_of(base.numpy()) == wl.SOLID):
            raise ValueError("the state's solids are not this scene's")
        return own, cells, numbers


def _cells(pieces: Sequence[Piece]) -> dict[str, Any]:
    """Return the names and types of what pieces have in cells."""
    return CELLS | {name: dtype for name, dtype in LATER.items() if all(name in piece for piece in pieces)}


def _numbers(pieces: Sequence[Piece], others: Sequence[str], signature: np.ndarray) -> dict[str, np.ndarray]:
    """Return the numbers that all pieces have alike, after a look whether they have all else, and belong to a scene."""
    missing = sorted({name for piece in pieces for name in (*NUMBERS, *others) if name not in piece})
    if missing or not pieces:
        raise ValueError(f"the state lacks {', '.join(missing) or 'pieces'}: it does not belong to this scene on ranks")
    numbers = {name: np.asarray(pieces[0][name]) for name in NUMBERS}
    if not np.array_equal(numbers["signature"], signature):
        raise ValueError("the state's grid, spacing, number of particles a cell or transfer differ from this scene's")
    if any(not np.array_equal(numbers[name], piece[name]) for piece in pieces for name in NUMBERS):
        raise ValueError("the pieces are of different states")
    return numbers


def _in_box(part: Subdomain, piece: Piece) -> np.ndarray:
    """Tell which of a piece's particles are in this rank's box; cells are found as kernels find them."""
    inverse, one = np.float32(1.0 / part.grid.spacing), np.float32(1.0)
    inside = np.ones(len(piece["place"]), dtype=bool)
    for axis in range(part.grid.dimension):
        coordinate = np.asarray(piece["position"][:, axis], dtype=np.float32) * inverse + one
        cell = np.clip(coordinate, one, np.float32(part.decomposition.counts[axis])).astype(np.int64) - 1
        inside &= (cell >= part.box.low[axis]) & (cell < part.box.high[axis])
    return inside
