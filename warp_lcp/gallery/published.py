"""Published figures of the gallery's problems and how they are recomputed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from functools import cache, partial

import numpy as np
import warp as wp

from warp_lcp.gallery.heston import Heston
from warp_lcp.gallery.obstacle import ball_obstacle, dam, journal_bearing, sine_obstacle, torsion
from warp_lcp.gallery.shallow_ice import IceDome
from warp_lcp.host_problem import Problem
from warp_lcp.method_selection import solve
from warp_lcp.operators.grid_poisson import FLUID
from warp_lcp.problem.stopping import StoppingCriteria
from warp_lcp.settings import renamed_names

PETSC, CUTEST, P4PDES = "PETSc", "CUTEst", "p4pdes"
SPG = "CSPG.jl"  # its table of CUTEst's problems, with the spectral projected gradient method


@dataclass(frozen=True)
class PublishedFigure:
    """Published figure and the function that recomputes it.

    Attributes:
        problem: name of the problem, a heading of docs/problems.md.
        case: size, data, and the quantity.
        printed: the number, without zeros that only fill a column.
        source: its source.
        measure: function that recomputes it.
        within: allowed difference if our value differs, for a reason in docs/problems.md; 0 if all
            digits agree.
        slow: whether it takes more than a few seconds.
    """

    problem: str
    case: str
    printed: str
    source: str
    measure: Callable[[], float]
    within: float = 0.0
    slow: bool = False

    @property
    def tolerance(self) -> float:
        """Half a unit of the last printed digit, or `within`."""
        exponent = Decimal(self.printed).as_tuple().exponent
        assert isinstance(exponent, int)
        # Rounded half up, and for binary fractions.
        return self.within or 0.5 * 10.0**exponent * (1 + 1e-6)


def solution(problem: Problem) -> np.ndarray:
    """Return the solution of a gallery problem to 12 digits, on the host.

    Raises:
        RuntimeError: the solve failed; the message has the status.
    """
    result = solve(problem.lcp(), stopping=StoppingCriteria(rtol=1e-12))
    if not result:
        raise RuntimeError(f"{problem.name}: {result.status.name}")
    return result.x.numpy()


def _energy(
    make: Callable[..., Problem], *sizes: float, **options: float | bool
) -> Callable[[], float]:
    def measure() -> float:
        problem = make(*sizes, device="cpu", dtype=wp.float64, **options)
        return problem.energy(solution(problem))

    return measure


def _bearings() -> list[PublishedFigure]:
    """Return the published figures of journal bearings."""
    rows = [(8, 12, 0.1, "-.183437"), (10, 16, 0.9, "-15.607"), (50, 50, 0.99, "-60.1509")]
    figures = [
        PublishedFigure(
            "Journal bearing",
            f"jbearing2, {nx} x {ny}, e = {e}",
            printed,
            PETSC,
            _energy(journal_bearing, nx, ny, e),
        )
        for nx, ny, e, printed in rows
    ]
    published = {
        4: "-0.22474",
        10: "-0.17896",
        23: "-0.18005",
        32: "-0.18030",
        75: "-0.18055",
        100: "-0.18057",
        125: "-0.18058",
    }
    for n, printed in published.items():
        figures.append(
            PublishedFigure(
                "Journal bearing",
                f"JNLBRNG1, {n} x {n}",
                printed,
                CUTEST,
                _energy(journal_bearing, n - 2, n - 2, 0.1),
            )
        )
    for name, e, printed, within in (
        ("JNLBRNG1", 0.1, "-1.80573195e-01", 1e-7),
        ("JNLBRNG2", 0.5, "-4.14865279e+00", 4e-8),
    ):
        figures.append(
            PublishedFigure(
                "Journal bearing",
                f"{name}, 100 x 100",
                printed,
                SPG,
                _energy(journal_bearing, 98, 98, e),
                within,
            )
        )
    return figures


# (name, load, border): {Q: (printed, within)}.
TORSIONS: dict[tuple[str, float, float], dict[int, tuple[str, float]]] = {
    ("TORSION1", 5.0, 0.5): {
        2: ("-5.1851852e-1", 0),
        5: ("-4.9234185e-1", 0),
        11: ("-4.5608771e-1", 0),
    },
    ("TORSION3", 10.0, 0.5): {
        2: ("-1.2592592567", 3e-9),
        5: ("-1.2705380252", 3e-9),
        11: ("-1.2422498827", 3e-9),
    },
    ("TORSION5", 20.0, 0.5): {
        2: ("-2.7407407353", 6e-9),
        5: ("-2.8971193358", 6e-9),
        11: ("-2.8847068155", 6e-9),
    },
    ("TORSIONA", 5.0, 1.0): {
        2: ("-0.30864", 0),
        5: ("-0.40570", 0),
        11: ("-0.41611", 0),
        16: ("-0.41740", 0),
        37: ("-0.41830", 0),
        50: ("-0.41839", 0),
        61: ("-0.41842", 0),
    },
    ("TORSIONC", 10.0, 1.0): {
        2: ("-1.0370", 0),
        5: ("-1.1766", 0),
        11: ("-1.1995", 0),
        16: ("-1.2023", 0),
        37: ("-1.2042", 0),
        50: ("-1.2044", 0),
        61: ("-1.2045", 0),
    },
    ("TORSIONE", 20.0, 1.0): {
        2: ("-2.5185", 0),
        5: ("-2.7984", 0),
        11: ("-2.8406", 0),
        16: ("-2.8461", 0),
        37: ("-2.8502", 0),
        50: ("-2.8507", 0),
        61: ("-2.8508", 0),
    },
}
TORSIONS_SPG = [
    ("TORSION1", 5.0, 0.5, "-4.30275769e-01", 4e-8),
    ("TORSION3", 10.0, 0.5, "-1.21695608e+00", 0),
    ("TORSION5", 20.0, 0.5, "-2.86337797e+00", 0),
    ("TORSIONA", 5.0, 1.0, "-4.18296119e-01", 4e-8),
    ("TORSIONC", 10.0, 1.0, "-1.20420894e+00", 0),
    ("TORSIONE", 20.0, 1.0, "-2.85024786e+00", 0),
]


def _torsions() -> list[PublishedFigure]:
    """Return the published figures of torsion problems."""
    rows = [
        (*key, Q, *value, CUTEST) for key, values in TORSIONS.items() for Q, value in values.items()
    ]
    rows += [
        (name, load, border, 37, printed, within, SPG)
        for name, load, border, printed, within in TORSIONS_SPG
    ]
    return [
        PublishedFigure(
            "Torsion",
            f"{name}, Q = {Q}",
            printed,
            source,
            _energy(torsion, 2 * Q - 2, load, border=border),
            within,
        )
        for name, load, border, Q, printed, within, source in rows
    ]


def _sines() -> list[PublishedFigure]:
    """Return the published figures of membranes over obstacles."""
    hill = {
        4: "0.753659753",
        10: "1.397897560",
        23: "1.678027027",
        32: "1.748270031",
        100: "1.88646121e+00",
    }
    both = {
        4: "-0.0081108",
        10: "2.87503823",
        23: "6.51932527",
        32: "6.88708670",
        100: "7.27215590e+00",
    }
    return [
        PublishedFigure(
            "Sine obstacles",
            f"{name}, {n} x {n}",
            printed,
            SPG if n == 100 else CUTEST,
            _energy(sine_obstacle, n, n, between=between),
            2e-9 if not between and n < 100 else 0.0,
        )
        for name, between, known in (("OBSTCLAE", False, hill), ("OBSTCLBL", True, both))
        for n, printed in known.items()
    ]


NORMS: dict[str, Callable[[np.ndarray], float]] = {  # of errors
    "average": lambda errors: float(np.mean(errors)),
    "largest": lambda errors: float(np.max(errors)),
}


def _taken(
    take: Callable[[np.ndarray], float], errors: Callable[..., np.ndarray], *sizes: float
) -> float:
    return take(errors(*sizes))


@cache
def _ball_errors(n: int) -> np.ndarray:
    p = ball_obstacle(n, device="cpu", dtype=wp.float64)
    assert p.solution is not None
    return np.where(
        p.grid.cells.numpy()[1, 1:-1, 1:-1] == FLUID, np.abs(solution(p) - p.solution), 0.0
    )


def _balls() -> list[PublishedFigure]:
    """Return the published figures of the ball obstacle problem."""
    published = {
        5: ("4.531e-02", "1.635e-01"),
        9: ("3.076e-03", "1.334e-02"),
        17: ("2.707e-03", "1.428e-02"),
        33: ("8.182e-04", "5.747e-03"),
    }
    return [
        PublishedFigure(
            "Ball obstacle",
            f"{n} x {n}, {norm} error",
            printed,
            PETSC,
            partial(_taken, take, _ball_errors, n),
        )
        for n, values in published.items()
        for norm, take, printed in zip(NORMS, NORMS.values(), values, strict=True)
    ]


@cache
def _dam(nx: int) -> np.ndarray:
    return solution(dam(nx, (nx - 1) * 3 // 2 + 1, device="cpu", dtype=wp.float64))


def seepage_height(w: np.ndarray, *, high: float = 24.0, low: float = 4.0) -> float:
    """Return the height of the seepage face of a dam above the water behind it.

    It is that of the highest wet node beside the face, as in p4pdes/dam.c.

    Args:
        w: solution of `dam`, shape (ny, nx).
        high: height of the dam, in any unit of length.
        low: depth of the water behind it.
    """
    y = np.linspace(0, high, len(w))
    return float(y[w[:, -2] > 1e-6].max()) - low


def _entry(j: int, i: int) -> float:
    return float(_dam(5)[j, i])


def _height(nx: int) -> float:
    return seepage_height(_dam(nx))


def _dams() -> list[PublishedFigure]:
    """Return the published figures of dams."""
    rows = {
        5: ("2.53716015237691",),
        4: ("18.148640609503", "6.78414305345868"),
        3: ("47.2732592321936", "24.9879316043211", "7.91201621181146"),
        2: ("89.9564647149903", "53.982307919772", "22.6601332428759"),
        1: ("146.570291707977", "94.3247021169195", "44.7462088399388"),
    }
    figures = [
        PublishedFigure(
            "Dam", f"5 x 7, w at ({i}, {j})", printed, P4PDES, partial(_entry, j, i), 2e-11
        )
        for j, values in rows.items()
        for i, printed in enumerate(values, 1)
    ]
    heights = {
        9: "10.0000000",
        129: "8.8750000",
        257: "8.7500000",
        513: "8.7500000",
        1025: "8.7343750",
        2049: "8.7187500",
    }
    for nx, printed in heights.items():
        case = f"{nx} x {(nx - 1) * 3 // 2 + 1}, height of the seepage face"
        figures.append(
            PublishedFigure("Dam", case, printed, P4PDES, partial(_height, nx), slow=nx > 1025)
        )
    return figures


@cache
def _prices() -> np.ndarray:
    return Heston().extrapolated(np.arange(8.0, 13.0), 0.0625, 64, 32, 32, device="cpu")


def _price(k: int) -> float:
    return float(_prices()[k])


def _puts() -> list[PublishedFigure]:
    """Return the published figures of puts in Heston's model."""
    four, six = (
        ("2.0000", "1.1076", "0.5200", "0.2137", "0.0820"),
        ("2.00000", "1.10763", "0.520038", "0.213681", "0.082046"),
    )
    return [
        PublishedFigure(
            "American put", f"S = {8 + k}, {digits}", value[k], source, partial(_price, k), within
        )
        for digits, value, source, within in (
            ("to 4 digits", four, "QuantLib, rounded", 0.0),
            ("more digits", six, "QuantLib", 2e-5),
        )
        for k in range(5)
    ]


@cache
def _ice_errors(nodes: int, regularization: float) -> np.ndarray:
    dome = IceDome(nodes=nodes, regularization=regularization)
    return np.abs(dome.solve(device="cpu") - dome.thickness())


def _domes() -> list[PublishedFigure]:
    """Return the published figures of ice domes."""
    rows = [
        (1e-3, "largest", "938.275"),
        (1e-3, "average", "147.420"),
        (0.1, "largest", "938.275"),
        (0.1, "average", "150.765"),
    ]
    return [
        PublishedFigure(
            "Ice dome",
            f"9 x 9, {share} of D constant, {norm} error [m]",
            printed,
            P4PDES,
            partial(_taken, NORMS[norm], _ice_errors, 9, share),
        )
        for share, norm, printed in rows
    ]


PUBLISHED = (*_bearings(), *_torsions(), *_sines(), *_balls(), *_dams(), *_puts(), *_domes())


__getattr__ = renamed_names(__name__, Published="PublishedFigure")
