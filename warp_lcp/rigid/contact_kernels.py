"""A pass over contacts: nonlinear conjugate gradients on projected sweeps, a whole solve of an island of bodies by one thread.

`warp_lcp.solvers.nncg` on B = J J' + diag(e), whose rows live at bodies: a sweep costs the entries of J, not those of B, and a solve one
launch. Contacts of a pile are so few that launches would take all of the time: 0.2 ms an iteration where the arithmetic takes 0.002 ms.
"""

from pathlib import Path

import warp as wp

from warp_lcp.rows import RowPass

_INDICES = ("one", "other", "starts")  # a contact's bodies, an island's first contact
NNCG = RowPass(
    "warp_lcp.rigid.contacts.nncg",
    Path(__file__).parent / "headers" / "nncg.h",
    wp.float64,
    box={"residual": wp.float64},  # of each island, relative to that of x = 0
    whole=dict.fromkeys(("J", "b", "e", "d", "mu", "w", "g", "way", "best", "x"), wp.float64) | dict.fromkeys(_INDICES, wp.int32),
    numbers={"q": int, "dim": int, "rtol": wp.float64, "most": int},
    constants={"EACH": 8},  # iterations between looks at the residual, which costs as much as a sweep
)
