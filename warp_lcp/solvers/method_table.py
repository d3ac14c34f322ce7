"""The table of methods, empty: `registry` fills it.

A method that goes on by another one looks it up here when it needs it. So no method's module imports that of a method that may go on by it.
"""

from __future__ import annotations

from typing import Any

from warp_lcp.settings import nearest

ALSO = {
    "ipm": "interior-point",
    "pgs": "psor",
    "sor": "psor",
    "gauss-seidel": "psor",
    "jacobi": "projected-jacobi",
    "simplex": "lemke",
    "piqp": "quadratic-program",
}


class Methods(dict[str, type[Any]]):
    """Methods by their names; an unknown one's KeyError says which is meant, or which there are."""

    def __missing__(self, name: str) -> type[Any]:
        """Refuse a name that no method has."""
        raise KeyError(f"no such method: {name!r}; {self.nearest(name)}")

    def nearest(self, name: object) -> str:
        """Return `did you mean ...?` for initials, class names and synonyms, else `settings.nearest`."""
        word = str(name).lower().replace("_", "-").replace(" ", "-")
        for known, kind in self.items():
            initials = "".join(part[0] for part in known.split("-"))
            if ALSO.get(word, known) == known and (word in ALSO or word in (initials, kind.__name__.lower())):
                return f"did you mean {known!r}?"
        return nearest(word, self)


METHODS = Methods()
