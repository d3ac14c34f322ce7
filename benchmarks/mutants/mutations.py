"""Mutation operators.

They are operators of cosmic-ray that leave plausible code, omitted calls, changed operators in C++
headers, and changed formulas.
"""

from __future__ import annotations

import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import parso
from cosmic_ray.ast import ast_nodes
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator
from cosmic_ray.plugins import get_operator

from warp_lcp.benchmarks.mutants.formulas import FORMULAS

if TYPE_CHECKING:
    from parso.tree import NodeOrLeaf

PACKAGES = ("warp_lcp", "fluids", "granular")
# Lines whose changes show only to a type checker, a clock or a reader.
UNSEEN = re.compile(r"TYPE_CHECKING|enable_backward|\(\d+, \d+, \d+\)|\[\d+, \d+, \d+\]")
# Needs MPI ranks; package names; tables of numbers.
APART = re.compile(r"/distributed|/__init__\.py$|/rank_|_table\.py$")

BINARY = (
    "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Mul Mod_FloorDiv Pow_Mul BitAnd_BitOr "
    "BitOr_BitAnd LShift_RShift"
)
COMPARISON = (
    "Lt_LtE Lt_GtE LtE_Lt LtE_Gt Gt_GtE Gt_LtE GtE_Gt GtE_Lt Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is"
)
PLAIN = (
    "AddNot NumberReplacer ReplaceAndWithOr ReplaceOrWithAnd ReplaceTrueWithFalse "
    "ReplaceFalseWithTrue ReplaceBreakWithContinue"
)
NAMES = (
    *(f"core/ReplaceBinaryOperator_{name}" for name in BINARY.split()),
    *(f"core/ReplaceComparisonOperator_{name}" for name in COMPARISON.split()),
    *(f"core/{name}" for name in PLAIN.split()),
    "core/ReplaceUnaryOperator_Delete_Not",
    "core/ReplaceUnaryOperator_USub_UAdd",
)
SWAPS = {
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "<": "<=",
    "<=": "<",
    ">": ">=",
    ">=": ">",
    "==": "!=",
    "!=": "==",
    "&&": "||",
    "||": "&&",
}
SWAPS |= {"&": "|", "|": "&"}
NATIVE_SWAP = "NativeSwap"  # replaces one of them by its neighbor
FORMULA = "Formula"  # one of FORMULAS
NATIVE = re.compile(
    r"(?<=[\w\])] )(?:[<>=!]=|&&|\|\||[-+*/<>&|])(?= [\w(!-])|(?<=[\w\])])[*/](?=[\w(])"
)


Position = tuple[int, int]  # line and column


class StatementDeletion(Operator):
    """Replace a call statement or an in-place change of a variable by `pass`."""

    def mutation_positions(self, node: NodeOrLeaf) -> Iterator[tuple[Position, Position]]:
        """Yield the start and the end of such a statement."""
        statement = node.parent is not None and node.parent.type == "simple_stmt"
        call = node.type == "atom_expr" and getattr(node.children[-1], "children", [""])[0] == "("
        inplace = node.type == "expr_stmt" and getattr(
            node.children[1], "value", node.children[1].type
        ) not in ("=", "annassign")
        if statement and (call or inplace):
            yield node.start_pos, node.end_pos

    def mutate(self, node: NodeOrLeaf, index: int) -> NodeOrLeaf:
        """Return `pass`."""
        return parso.python.tree.Keyword("pass", node.start_pos, node.get_first_leaf().prefix)

    @classmethod
    def examples(cls) -> tuple[()]:
        """Return no examples."""
        return ()


class Mutant(NamedTuple):
    """One change: file, line, operator, occurrence, and the lines before and after.

    The occurrence counts the operator's places in the file.
    """

    module: str
    line: int
    operator: str
    occurrence: int
    before: str
    after: str


def operator(name: str) -> Operator:
    """Return a mutation operator by name."""
    return StatementDeletion() if name == "StatementDeletion" else get_operator(name)()


def native_places(source: str) -> list[re.Match[str]]:
    """Return the operators of a header, outside comments and preprocessor lines."""
    return [
        m
        for m in NATIVE.finditer(source)
        if not re.search(r"//|^\s*#", source[source.rfind("\n", 0, m.start()) + 1 : m.start()])
    ]


def mutated(source: str, name: str, occurrence: int) -> str:
    """Return the source with one change."""
    if name == FORMULA:
        return source.replace(FORMULAS[occurrence].before, FORMULAS[occurrence].after)
    if name == NATIVE_SWAP:
        match = native_places(source)[occurrence]
        return source[: match.start()] + SWAPS[match[0]] + source[match.end() :]
    return str(mutate_code(source, operator(name), occurrence))


def of_formulas(root: Path) -> list[Mutant]:
    """Return the mutants of FORMULAS."""
    mutants = []
    for number, (module, before, after, _) in enumerate(FORMULAS):
        source = (root / module).read_text()
        mutants.append(
            Mutant(
                module,
                source.count("\n", 0, source.index(before)) + 1,
                FORMULA,
                number,
                before.strip(),
                after.strip(),
            )
        )
    return mutants


def draw(root: Path, count: int, seed: int) -> list[Mutant]:
    """Return mutants at equally spaced lines of all modules.

    Each has an operator that applies at its line or near it.

    Args:
        root: folder that contains the packages.
        count: number of mutants.
        seed: seed of the first line and of the operators.
    """
    rng = random.Random(seed)
    files = sorted(
        str(f.relative_to(root))
        for package in PACKAGES
        for f in (root / package).rglob("*")
        if f.suffix in (".py", ".h")
    )
    lines = [
        (f, n + 1)
        for f in files
        if not APART.search(f)
        for n, text in enumerate((root / f).read_text().splitlines())
        if text.strip()
    ]
    start = rng.random()
    wanted = [lines[int((start + i) * len(lines) / count)] for i in range(count)]
    sources = {module: (root / module).read_text() for module in {module for module, _ in wanted}}
    places = {module: _places(module, source) for module, source in sources.items()}
    mutants = []
    for module, line in wanted:
        if places[module]:
            nearest = min(abs(at - line) for at, *_ in places[module])
            at, name, occurrence = rng.choice(
                [place for place in places[module] if abs(place[0] - line) == nearest]
            )
            old, new = (
                text.splitlines()
                for text in (sources[module], mutated(sources[module], name, occurrence))
            )
            mutants.append(
                Mutant(module, at, name, occurrence, old[at - 1].strip(), new[at - 1].strip())
            )
    return mutants


def _places(module: str, source: str) -> list[tuple[int, str, int]]:
    """Return line, operator name and occurrence of a file's possible changes.

    Annotations, raised expressions and UNSEEN lines are left out.
    """
    if module.endswith(".h"):
        return [
            (source.count("\n", 0, match.start()) + 1, NATIVE_SWAP, n)
            for n, match in enumerate(native_places(source))
        ]
    nodes = [(node, _inert(node)) for node in ast_nodes(parso.parse(source))]
    places, lines = [], source.splitlines()
    for name in (*NAMES, "StatementDeletion"):
        change, occurrence = operator(name), 0
        for node, inert in nodes:
            for begin, _ in change.mutation_positions(node):
                if not inert and not UNSEEN.search(lines[begin[0] - 1]):
                    places.append((begin[0], name, occurrence))
                occurrence += 1
    return places


def _inert(node: NodeOrLeaf) -> bool:
    """Return whether a node is in an annotation, a decorator or a raise statement.

    Also whether it is a bare `*` between parameters.
    """
    if node.parent is not None and node.parent.type == "parameters":
        return True
    while node.parent is not None:
        before = node.get_previous_sibling()
        annotated = node.parent.type in ("tfpdef", "annassign", "funcdef") and node.type != "suite"
        if annotated and getattr(before, "value", "") in (":", "->"):
            return True
        node = node.parent
        if node.type in ("raise_stmt", "decorator"):
            return True
    return False
