"""Selection of a rank's state from the pieces of any number of ranks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

import warp_lcp as wl
from warp_lcp.distributed.decomposition import CellBox
from warp_lcp.grid.particle_ids import ID
from warp_lcp.material.particle_pieces import LATER, Piece, fields_of

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain

CLOCK = ("time", "step_count", "last_dt")


def take_pieces(
    part: Subdomain,
    particles: Sequence[str],
    like: Mapping[str, np.ndarray],
    signature: np.ndarray,
    pieces: Sequence[Piece],
    solids: np.ndarray | None,
) -> tuple[Piece, Piece, Piece]:
    """Select from pieces the particles and cells in this rank's box; collective.

    Args:
        part: the subdomain of this rank.
        particles: names of the particles' arrays: `id`, int64 of shape (n,); the others float32 of
            shape (n, 3).
        like: the other arrays of the part: its fields, `cells` among them, and numbers, which are
            the same in all pieces.
        signature: numbers that tell this scene's state from another's.
        pieces: of all ranks of a run.
        solids: int8, SOLID in cells without material, of the part; None: solids move.

    Returns:
        By name: the particles with their `place`, the cells of this rank's box, shape (..., nz, ny,
        nx), and the numbers that are the same in all pieces.

    Raises:
        ValueError: the pieces do not belong to this scene, or do not cover the domain; on all
            ranks.
    """
    with part.decomposition.collective.root_only():
        fields = fields_of(like)
        alike = (*CLOCK, *(name for name in like if name not in fields), "signature", "counts")
        numbers = _numbers(
            pieces,
            alike,
            [*particles, "place", "box", *(name for name in fields if name not in LATER)],
            signature,
        )
        kinds = {
            name: (field.dtype, field.shape[:-3])
            for name, field in fields.items()
            if name not in LATER
        }
        kinds |= {
            name: (np.dtype(dtype), ())
            for name, dtype in LATER.items()
            if all(name in piece for piece in pieces)
        }
        cells = {
            name: np.zeros((*layers, *part.box.counts[::-1]), dtype=dtype)
            for name, (dtype, layers) in kinds.items()
        }
        own_piece: Piece = {
            name: np.empty(0, dtype=np.int64)
            if name in (ID, "place")
            else np.empty((0, 3), dtype=np.float32)
            for name in (*particles, "place")
        }
        covered, parts = 0, [own_piece]
        for piece in pieces:
            box = CellBox.of(*piece["box"])
            shared = box.common(part.box)
            covered += shared.cells
            for name, values in cells.items() if shared.cells else ():
                values[..., *shared.moved(part.box.low, -1).slices] = piece[name][
                    ..., *shared.moved(box.low, -1).slices
                ]
            # Particles migrate to their rank when the next step begins.
            if part.decomposition.boxes_overlap(box.grown(part.layers), part.box):
                inside = part.owners(cells_of(part, piece["position"])) == part.ranks.rank
                parts.append({name: np.asarray(piece[name])[inside] for name in own_piece})
        own_piece = {
            name: np.ascontiguousarray(np.concatenate([p[name] for p in parts]))
            for name in own_piece
        }
        if covered != part.box.cells:
            raise ValueError("the pieces do not cover the domain: some are missing or duplicated")
        if any(
            values.dtype.kind == "f" and not np.isfinite(values).all()
            for values in (*own_piece.values(), *cells.values())
        ):
            raise ValueError("the pieces hold values that are not finite")
        if solids is not None and not np.array_equal(
            cells["cells"] == wl.SOLID, part.box_of(solids) == wl.SOLID
        ):
            raise ValueError("the state's solids are not this scene's")
        return own_piece, cells, numbers


def _numbers(
    pieces: Sequence[Piece], names: Sequence[str], other_names: Sequence[str], signature: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the numbers that all pieces share.

    The pieces are first checked: they must agree in everything else and belong to a scene.
    """
    missing = sorted(
        {name for piece in pieces for name in (*names, *other_names) if name not in piece}
    )
    if missing or not pieces:
        raise ValueError(
            f"the state lacks {', '.join(missing) or 'pieces'}: it does not belong to this scene "
            "on ranks"
        )
    numbers = {name: np.asarray(pieces[0][name]) for name in names}
    if not np.array_equal(numbers["signature"], signature):
        raise ValueError(
            "the state's grid, spacing, number of particles a cell or transfer differ from this "
            "scene's"
        )
    if any(not np.array_equal(numbers[name], piece[name]) for piece in pieces for name in names):
        raise ValueError("the pieces belong to different states")
    return numbers


def cells_of(part: Subdomain, position: np.ndarray) -> np.ndarray:
    """Return the cells (x, y, z) of positions [m], as kernels compute them.

    They count over the whole domain. Shape (n, 3).
    """
    inverse, one = np.float32(1.0 / part.grid.spacing), np.float32(1.0)
    cells = np.zeros((len(position), 3), dtype=np.int64)
    for axis in range(part.grid.dimension):
        coordinate = np.asarray(position[:, axis], dtype=np.float32) * inverse + one
        cells[:, axis] = (
            np.clip(coordinate, one, np.float32(part.decomposition.counts[axis])).astype(np.int64)
            - 1
        )
    return cells
