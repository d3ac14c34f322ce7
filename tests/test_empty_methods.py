"""Empty methods of serial classes that a subclass overrides: each has a reason.

They do nothing, or return an argument or a constant.
"""

import ast
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

from parsed_sources import parsed, statements

ROOT = Path(__file__).parent.parent
# Class, or class and method: why a subclass may replace an empty method.
ALLOWED = {
    "GridPart": "the one place where one process and a rank differ; here nothing is exchanged",
    "ParticleExchange": "likewise for particles",
    "Launcher": "carries a command in one process; that of ranks agrees on arguments first",
    "WorkspaceDefaults": "what a workspace says that begins nothing on the device",
    "Scene": "a scene without particles, sides and joints; the models of its simulators have them",
    "ParticleScene": "what a material says of itself; sand says it all with constants",
    "Sweep": "what sweeps a method that moves x by itself: nothing",
    "CommandBuffer.fits": "a recording for a GPU has launch dimensions that may be too small",
    "_SolveLoop._merits": "merit functions are those of boxes",
    "_Shape.unit_length": "a mesh counts in units of its size",
}


def is_empty(method: ast.FunctionDef) -> bool:
    """Return whether the body is a docstring, `pass` or a trivial return.

    Trivial: the return of arguments or constants.
    """
    arguments = {argument.arg for argument in (*method.args.args, *method.args.kwonlyargs)}

    def plain(value: ast.expr | None) -> bool:
        if isinstance(value, ast.Tuple | ast.List):
            return all(map(plain, value.elts))
        empty = isinstance(value, ast.Dict) and not value.keys
        return (
            value is None
            or empty
            or isinstance(value, ast.Constant)
            or (isinstance(value, ast.Name) and value.id in arguments)
        )

    def nothing(statement: ast.stmt) -> bool:
        said = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
        return (
            said
            or isinstance(statement, ast.Pass)
            or (isinstance(statement, ast.Return) and plain(statement.value))
        )

    return all(map(nothing, method.body))


def overridden(trees: Iterable[ast.Module]) -> Iterator[str]:
    """Yield Class.method of overridden empty methods.

    They are not abstract, of no protocol, and overridden by a class below.
    """
    methods: dict[str, dict[str, ast.FunctionDef]] = defaultdict(dict)
    below: dict[str, set[str]] = defaultdict(set)
    protocols = set()
    for tree in trees:
        for node in statements(tree):
            if isinstance(node, ast.ClassDef):
                bases = [ast.unparse(base).split("[")[0].split(".")[-1] for base in node.bases]
                methods[node.name] |= {
                    m.name: m for m in node.body if isinstance(m, ast.FunctionDef)
                }
                protocols |= {node.name} & ({node.name} if "Protocol" in bases else set())
                for base in bases:
                    below[base].add(node.name)

    def descendants(name: str) -> set[str]:
        return below[name].union(*map(descendants, below[name]))

    for name in list(methods):
        for method in methods[name].values() if name not in protocols else ():
            abstract = any(
                "abstractmethod" in ast.unparse(decorator) for decorator in method.decorator_list
            )
            if (
                not abstract
                and is_empty(method)
                and any(method.name in methods[other] for other in descendants(name))
            ):
                yield f"{name}.{method.name}"


def test_no_method_waits_for_a_subclass_without_a_reason():
    files = [
        path
        for folder in ("warp_lcp", "fluids", "granular")
        for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    found = set(overridden(parsed(path) for path in files if "benchmarks" not in path.parts))
    assert "GridPart.fill" in found
    assert set(ALLOWED) <= found | {method.split(".")[0] for method in found}
    assert not {
        method for method in found if method not in ALLOWED and method.split(".")[0] not in ALLOWED
    }


def test_empty_methods_are_recognized():
    source = """
class Base:
    def a(self): "Do nothing."
    def b(self, x): return x
    def c(self): return ()
    def d(self): return self.x
    @abstractmethod
    def e(self): pass
    def f(self): pass
class Interface(Protocol):
    def a(self): ...
class Middle(Base):
    def a(self): return 1 + 1
    def d(self): return 2
    def e(self): return 2
class Last(Middle):
    def b(self, x): return 2 * x
    def c(self): return (1, 2, self)
class Mine(Interface):
    def a(self): return 3 + 4
"""
    assert set(overridden([ast.parse(source)])) == {"Base.a", "Base.b", "Base.c"}
