"""The start of Lemke and Howson's method, for bimatrix games."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_lcp.solvers.lemke import Basis


def strategies(M: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the unknowns of two players, None if this is no game.

    A bimatrix game of costs has M = [[0, E], [F', 0]], E > 0, F > 0 and q < 0, in some order.
    """
    if not (q < 0).all() or (M.diagonal() != 0).any():
        return None
    own = M[0] == 0
    first, second = np.flatnonzero(own), np.flatnonzero(~own)
    within = [M[np.ix_(player, player)] for player in (first, second)]
    across = [M[np.ix_(*players)] for players in ((first, second), (second, first))]
    return (first, second) if all((A == 0).all() for A in within) and len(second) and all((A > 0).all() for A in across) else None


def start_game(basis: Basis) -> bool:
    """Begin with the first player's first strategy; return False if this is no game.

    w = q + M z. Lemke's z0, with d > 0, makes all w >= 0; the first complement that enters then
    meets no row, as its block of M is 0: a ray. Lemke and Howson begin with z_k alone, as large as
    makes w >= 0 for the other player, w_s = 0 there; then z_s, as large as makes w >= 0 for the
    first one, w_r = 0 there. That is a feasible basis, complementary but for pair k: the solution
    if r = k. Else z_r enters, and the path ends where a variable of pair k leaves; as E, F > 0, it
    meets no ray.
    """
    players = strategies(basis.M, basis.q)
    if players is None:
        return False
    m, pair = basis.m, int(players[0][0])
    entering = pair
    for rows in reversed(players):
        sizes = -basis.q[rows] / basis.M[rows, entering]
        # of ties the last: the rows of the others stay lexicographically positive
        row = int(rows[np.flatnonzero(sizes >= sizes.max())[-1]])
        basis.exchange(row, m + entering)
        entering = row
    basis.ends = (pair, m + pair)
    basis.entering = -1 if entering == pair else m + entering
    return True
