"""What [Book] appendix C concludes, beside what was measured here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from warp_lcp.benchmarks.record import Record, Table


def claims(records: Sequence[Record]) -> Table:
    """Return the table; its figures are those of the records."""
    found = {r.name: r for r in records}
    rows = [
        ["PGS and PSOR are accepted on all fluid problems (C.1)", *_sweeps(found)],
        ["PSOR 1.4 is about twice as fast as PGS (C.2: 25.29 and 49.38)", *_ratio(found)],
        ["a relaxation factor of 1.4 is best (C.4)", *_factor(records)],
        ["Newton on the minimum map fails on all contact problems (C.1)", *_minimum_map(found)],
        ["Fischer-Newton solves all contact problems (C.1)", *_fischer(found)],
        ["the perturbation strategy is slightly the best for contacts (C.3)", *_kinks(found)],
        ["Lemke's cost is cubic (C.5)", *_lemke(found)],
        ["Fischer-Newton should be linear in the unknowns if no Jacobian is assembled (C.5)", *_linear(found)],
        ["ten sweeps of PGS at least halve the iterations of Newton methods (C.6)", *_warm(found)],
        ["Newton methods get into trouble with many zero eigenvalues", *_zeros(found)],
    ]
    return Table("What the book concludes, and what is found here", ["the book", "here", "why"], rows, "Figures of the tables below.")


def _value(found: Mapping[str, Record], name: str, figure: str) -> float | None:
    return found[name].value(figure) if name in found else None


def _text(value: float | None, form: str = ".2f") -> str:
    return "none" if value is None else f"{value:{form}}"


def _solved(found: Mapping[str, Record], name: str) -> str:
    return f"{_text(_value(found, name, 'solved'), '.0f')} of {_text(_value(found, name, 'problems'), '.0f')}"


def _sweeps(found: Mapping[str, Record]) -> tuple[str, str]:
    parts = [_solved(found, f"robustness: {kind}: PGS") for kind in ("fluid, recipe", "fluid, 7-point, planted", "contact, rigid bodies")]
    accepted = _value(found, "robustness: contact, recipe: PGS", "accepted")
    residual = _value(found, "robustness: contact, recipe: PGS", "residual")
    here = f"PGS to 1e-6 of the natural residual in 100 sweeps: {parts[0]} (recipe), {parts[1]} (planted), {parts[2]} (rigid bodies)"
    why = (
        f"x'abs(y) < 1e-3 is no test of a solution: it accepts {_text(accepted, '.0f')} of Num4LCP's contact problems with "
        f"natural residuals up to {_text(residual)} of the first one"
    )
    return here, why


def _ratio(found: Mapping[str, Record]) -> tuple[str, str]:
    pairs = []
    for kind in ("fluid, recipe", "fluid, 7-point, planted"):
        pgs, psor = (_value(found, f"robustness: {kind}: {m}", "iterations") for m in ("PGS", "PSOR 1.4"))
        pairs.append(f"{pgs / psor:.2f} x ({kind.partition(', ')[2]})" if pgs and psor else "none")
    return ", ".join(pairs), "scattered active unknowns shorten the distances that PGS has to carry information over"


def _factor(records: Sequence[Record]) -> tuple[str, str]:
    best = {r.name.removeprefix("PSOR: "): r.value("best") for r in records if r.name.startswith("PSOR: ")}
    here = ", ".join(f"{_text(v, '.1f')} ({name})" for name, v in best.items())
    return here, "1.4 belongs to Num4LCP's banded matrices; on liquids the best factor grows with the cells along a side, as without bounds"


def _minimum_map(found: Mapping[str, Record]) -> tuple[str, str]:
    parts = []
    for kind in ("recipe", "recipe's matrix, planted", "rigid bodies"):
        name = f"robustness: contact, {kind}: minimum map, book"
        parts.append(f"{found[name].facts['states']} ({kind})" if name in found else "none")
    solved = _solved(found, "robustness: contact, rigid bodies: minimum map, book")
    why = (
        "steps do not descend, or are cut until the merit stands still (relative, which is no solution). Steps solved exactly, of a map "
        "scaled by A_ii, reach the absolute test in some, Num4LCP's by GMRES in none. The library's method then goes on by the "
        f"proximal-point iteration: {solved} of the rigid bodies' problems to 1e-6"
    )
    return "; ".join(parts), why


def _fischer(found: Mapping[str, Record]) -> tuple[str, str]:
    kinds = ("recipe", "recipe's matrix, planted", "rigid bodies")
    book = [_solved(found, f"robustness: contact, {kind}: Fischer-Newton, book") for kind in kinds]
    ours = [_solved(found, f"robustness: contact, {kind}: FischerNewton()") for kind in kinds]
    here = "; ".join(f"{b}, with safeguards {o} ({kind})" for kind, b, o in zip(kinds, book, ours, strict=True))
    return (
        here,
        "impulses of bodies are harder than random matrices with their pattern: the plain search gets stuck, safeguards lead on",
    )


def _kinks(found: Mapping[str, Record]) -> tuple[str, str]:
    parts = []
    for kind in ("random", "zero", "perturbation", "approximation"):
        name = f"kinks: contact, rigid bodies: {kind}"
        parts.append(f"{kind} {_solved(found, name)}, {_text(_value(found, name, 'steps'))} steps")
    return "; ".join(
        parts
    ), "x = 0 is a kink of the beta rows, where the choice decides the first step; on bodies it decides who gets stuck, in no clear order"


def _lemke(found: Mapping[str, Record]) -> tuple[str, str]:
    lemke = _value(found, "cost: contact: Lemke", "solve exponent")
    fischer = _value(found, "cost: contact: FischerNewton", "solve exponent")
    return f"exponent {_text(lemke)}, Fischer-Newton with factors {_text(fischer)}", "at these sizes what is not cubic still counts"


def _linear(found: Mapping[str, Record]) -> tuple[str, str]:
    methods = ("FischerNewton", "MinimumMapNewton", "InteriorPoint", "ProjectedMultigrid")
    here = ", ".join(f"{m} {_text(_value(found, f'cost: grid: {m}', 'solve exponent'))}" for m in methods)
    return (
        f"exponents to 1e-6 on grids: {here}",
        "no Jacobian is assembled and multigrid preconditions; over 1: likely the caches, which the largest grid leaves, and InteriorPoint "
        "takes more steps",
    )


def _warm(found: Mapping[str, Record]) -> tuple[str, str]:
    parts = []
    for name in ("Fischer-Newton, book", "minimum map, book"):
        cold, warm = (_value(found, f"warm starting: planted: {name}: {start}", "iterations") for start in ("cold", "warm"))
        parts.append(f"{name}: {_text(cold)} and {_text(warm)}")
    return "; ".join(parts), "the tolerance of 1e-2 on the merit is loose: ten sweeps nearly meet it alone"


def _zeros(found: Mapping[str, Record]) -> tuple[str, str]:
    parts = []
    for rule in ("recipe", "planted"):
        label = f"overdetermined: {rule}: 80%: "
        solvable, name = _value(found, f"{label}solvable", "problems"), f"{label}Fischer-Newton, approximation"
        parts.append(f"80 % zeros, {rule}: {_text(solvable, '.0f')} solvable, Fischer-Newton solves {_solved(found, name)}")
    return "; ".join(parts), "the recipe's problems have no solution then; planted ones are solved"
