"""Wrong arguments: each is a ValueError that names the argument."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl
from warp_lcp.problem.operator_protocol import families
from warp_lcp.problem.operator_protocol import members as names_of
from warp_lcp.problem.solve_loop import solve as solve_by

A, B = np.array([[2.0, -1.0], [-1.0, 2.0]]), np.array([0.5, -2.5])
X = [0.5, 1.5]  # 2 * 0.5 - 1.5 + 0.5 = 0 and -0.5 + 2 * 1.5 - 2.5 = 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((A * 1j, B), "matrix is a ndarray of type complex128: expected real numbers"),
        ((A.astype(object), B), "matrix is a ndarray of type object"),
        ((A.tolist(), B), "A is a list"),
        ((None, B), "A is a NoneType"),
        ((A[0], B), r"matrix has shape \(2,\)"),
        ((A * np.nan, B), "matrix holds a value that is not finite"),
        ((scipy.sparse.csr_array(A * 1j), B), "matrix has entries of type complex128"),
        ((A, B * 1j), "b is a ndarray of type complex128"),
        ((A, ["one", "two"]), "b is a list of type"),
        ((A, None), "b is a NoneType"),
        ((A, [[1.0], [1.0, 2.0]]), "b: its rows differ in length"),
        ((A, B[:, None]), r"b has shape \(2, 1\): expected \(2,\)"),
        ((A, B * np.nan), "b holds 2 values that are not finite"),
        ((A, B, None), "lower is a NoneType"),
        ((A, B, 0.0, "x"), "upper is a str"),
        ((A, B, 0.0, ["a", "b"]), "upper is a list"),
        ((A, B, np.zeros(3)), r"lower has shape \(3,\)"),
        ((A, B, 0.0, np.array([1.0, np.nan])), "upper holds 1 NaN"),
    ],
)
def test_problems(arguments, message):
    with pytest.raises(ValueError, match=message):
        wl.LCP(*arguments)


def test_operators():
    with pytest.raises(ValueError, match="use SparseOperator"):
        wl.DenseOperator(scipy.sparse.csr_array(A))
    with pytest.raises(ValueError, match="DenseOperator takes numpy arrays"):
        wl.SparseOperator(A)
    for cls, matrix in ((wl.DenseOperator, A), (wl.SparseOperator, scipy.sparse.csr_array(A))):
        with pytest.raises(ValueError, match=r"must be wp.float32 or wp.float64"):
            cls(matrix, dtype=np.float32)
        with pytest.raises(ValueError, match="too large for float32"):
            cls(1e200 * matrix, dtype=wp.float32, device="cpu")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"solver": "lemk"},
            "solver = 'lemk': must be one of accelerated-projected-gradient, .*did you mean "
            "'lemke'",
        ),
        ({"solver": wl.Lemke}, "solver is the class Lemke"),
        ({"stopping": 1e-6}, "stopping is a float"),
        ({"solver": wl.Lemke(), "stopping": 1e-6}, "stopping is a float"),
        ({"x0": 0.0}, r"x0 has shape \(\)"),
        ({"x0": "zero"}, "x0 is a str"),
        ({"x0": [0.0, np.nan]}, "x0 holds 1 values that are not finite"),
        ({"x0": [1e300, 1e300]}, "x0 gives a residual that is not finite"),
    ],
)
def test_solves(options, message, device):
    with pytest.raises(ValueError, match=message):
        wl.solve(wl.LCP(wl.DenseOperator(A, device=device), B), **options)


def test_a_chosen_method_is_run_with_stopping_criteria_alone(device):
    problem = wl.LCP(wl.DenseOperator(A, device=device), B)
    with pytest.raises(ValueError, match="stopping is a float"):
        solve_by(problem, wl.Lemke(), stopping=1e-6)


def test_a_matrix_is_no_problem():
    with pytest.raises(ValueError, match="problem is a ndarray: expected an LCP"):
        wl.solve(A, wl.Lemke())


OPERATORS = {
    "dense": lambda device: wl.LCP(wl.DenseOperator(A, device=device), B),
    "sparse": lambda device: wl.LCP(wl.SparseOperator(scipy.sparse.csr_array(A), device=device), B),
    "grid": lambda device: wl.LCP(
        wl.GridPoisson(np.array([[1, 1, 0]]), device=device), np.array([[0.5, -2.5, 0.0]])
    ),
}


@pytest.mark.parametrize("name", [name for name, cls in wl.METHODS.items() if families(cls)])
def test_workspaces_of_another_method_problem_or_kind_are_refused(name, device):
    """Workspaces of another method, problem or kind: refused.

    Otherwise the solve fails with an AttributeError, or has the other method's iterates.
    """
    method = wl.METHODS[name]()
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    for family in families(wl.METHODS[name]):
        problem, twin = (OPERATORS[family](device) for _ in range(2))
        assert wl.solve(
            problem, method, workspace=method.init(problem), stopping=wl.StoppingCriteria(rtol=0.5)
        )
        with pytest.raises(ValueError, match="workspace was made for another problem"):
            wl.solve(problem, method, workspace=method.init(twin))
        for other, cls in wl.METHODS.items():
            # Two blocks are staggered.
            shared = (name, other) == ("blocked-gauss-seidel", "staggering")
            if other not in (name, "quadratic-program") and family in families(cls) and not shared:
                with pytest.raises(
                    ValueError, match=f"workspace is a .*: expected what {type(method).__name__}"
                ):
                    wl.solve(problem, method, workspace=cls().init(problem))
    for wrong in ({}, 3, "work", type(method.init(problem)), problem, np.zeros(2)):
        with pytest.raises(ValueError, match="workspace is "):
            wl.solve(problem, method, workspace=wrong)


@pytest.mark.parametrize(
    "setting",
    [{"max_iterations": 1.5}, {"max_iterations": -1}, {"patience": 0}, {"patience": float("nan")}],
)
def test_limits_are_integers(setting):
    with pytest.raises(ValueError, match=f"{next(iter(setting))} = .*: must be an integer >= "):
        wl.StoppingCriteria(**setting)


@pytest.mark.parametrize(
    "name", [name for name, cls in wl.METHODS.items() if "precision" in cls.__dataclass_fields__]
)
def test_precision_is_named(name):
    with pytest.raises(
        ValueError, match=r"precision = 'half': must be 'mixed', 'single' or 'double'"
    ):
        wl.METHODS[name](precision="half")


@pytest.mark.parametrize(
    "made",
    [
        lambda device: (A, B),
        lambda device: (A.astype(np.float32), B),
        lambda device: (np.asfortranarray(A), np.repeat(B, 2)[::2]),
        lambda device: ((2 * A).astype(int), [1, -5]),
        lambda device: (
            wp.array(A, dtype=wp.float32, device=device),
            wp.array(B, dtype=wp.float64, device=device),
        ),
        lambda device: (
            wp.array(A, dtype=wp.float64, device=device),
            wp.array(B, dtype=wp.float32, device=device),
        ),
        lambda device: (A, wp.array(np.repeat(B, 2), dtype=wp.float64, device=device)[::2]),
        lambda device: (scipy.sparse.coo_array(A), B),
        lambda device: (scipy.sparse.csc_matrix(A), B.astype(np.float32)),
    ],
)
def test_arrays_of_every_kind_are_taken(made, device):
    with wp.ScopedDevice(device):
        problem = wl.LCP(*made(device))
        assert problem.device == wp.get_device(device)
        np.testing.assert_allclose(wl.solve(problem, x0=[0, 1]).x.numpy(), X, atol=1e-5)


class ArrayLikeFrame:
    """Stand-in for a pandas object.

    It is no array, but `__array__` makes one of it; it has an `apply` of its own.
    """

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype)

    def apply(self, function):
        raise AssertionError


class ToNumpyTable:
    """Stand-in that `to_numpy` alone makes into an array."""

    def __init__(self, values):
        self.values = values

    def to_numpy(self):
        return np.array(self.values)


@pytest.mark.parametrize("kind", [ArrayLikeFrame, ToNumpyTable])
def test_what_converts_to_an_array_is_taken_as_one(kind):
    given = [kind(values) for values in (A, B, np.full(2, -1.0), np.full(2, 9.0))]
    np.testing.assert_allclose(
        wl.solve(wl.LCP(*given), x0=kind(np.ones(2))).x.numpy(), X, atol=1e-5
    )
    assert (
        wl.GridPoisson(
            kind([[1, 0]]), face_x=kind([[1.0, 2.0, 3.0]]), shift=kind([[4.0, 0.0]]), device="cpu"
        )
        .diagonal()
        .numpy()[0, 0]
        == 6
    )
    for wrong, message in (
        ([["a", "b"]], "A is a .* of type"),
        ([1.0, 2.0], r"matrix has shape \(2,\)"),
        (A * 1j, "of type complex128"),
    ):
        with pytest.raises(ValueError, match=message):
            wl.LCP(kind(wrong), B)


def masked(values, *where):
    mask = np.zeros(np.shape(values), dtype=bool)
    mask.ravel()[list(where)] = True
    return np.ma.array(values, mask=mask)


@pytest.mark.parametrize(
    ("make", "name", "count"),
    [
        (lambda: wl.LCP(masked(A, 1, 2), B), "matrix", 2),
        (lambda: wl.LCP(A, masked(B, 0)), "b", 1),
        (lambda: wl.LCP(A, B, masked(B, 1)), "lower", 1),
        (lambda: wl.LCP(A, B, -9.0, masked(np.ones(2), 0, 1)), "upper", 2),
        (lambda: wl.solve(wl.LCP(A, B), x0=masked(B, 1)), "x0", 1),
        (lambda: wl.GridPoisson(masked(np.ones((2, 2), dtype=int), 3)), "cells", 1),
        (
            lambda: wl.GridPoisson(np.ones((1, 2), dtype=int), face_x=masked(np.ones((1, 3)), 1)),
            "face_x",
            1,
        ),
        (
            lambda: wl.GridPoisson(np.ones((1, 2), dtype=int), shift=masked(np.ones((1, 2)), 1)),
            "shift",
            1,
        ),
        (lambda: wl.LowRankOperator(masked(np.ones((3, 1)), 1), np.ones(1)), "columns", 1),
        (lambda: wl.AffineBounds(masked(B, 1), np.full(2, -1), 0.0), "constant", 1),
    ],
)
def test_masked_entries_are_no_values(make, name, count):
    with pytest.raises(
        ValueError, match=rf"{name} is a masked array with {count} masked entries: .*{name}.filled"
    ):
        make()


def test_masked_arrays_without_masked_entries_are_taken():
    np.testing.assert_allclose(
        wl.solve(wl.LCP(masked(A), masked(B), masked(np.zeros(2)))).x.numpy(), X, atol=1e-5
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"face_x": 1e39},
            r"face_x holds values up to 1.0e\+39, too large for float32: pass dtype=wp.float64",
        ),
        ({"face_y": np.full((2, 2), 1e39)}, r"face_y holds values up to 1.0e\+39"),
        ({"shift": 1e100}, r"shift holds values up to 1.0e\+100"),
        (
            {"face_x": np.full((1, 3), 1e38), "shift": 2e38},
            r"face_x, face_y, face_z and shift add up to 4.0e\+38, too large for float32",
        ),
        (
            {"face_x": 1e-60},
            "face_x: 1 are not 0, but float32 takes them for it: pass dtype=wp.float64",
        ),
        ({"shift": np.array([[1e-60, 1.0]])}, "shift: 1 are not 0"),
    ],
)
def test_coefficients_beyond_their_type(options, message):
    cells = np.array([[wl.FLUID, wl.AIR]])
    with pytest.raises(ValueError, match=message):
        wl.GridPoisson(cells, **options)
    grid = wl.GridPoisson(cells, **options, dtype=wp.float64, device="cpu")
    d = grid.diagonal().numpy()[0, 0]
    result = wl.solve(wl.LCP(grid, np.array([[-d, 0.0]])), wl.MinimumMapNewton(precision="double"))
    np.testing.assert_allclose(result.x.numpy(), [[1.0, 0.0]])


def test_matrices_beyond_float32():
    for make in (
        wl.DenseOperator,
        lambda M, **options: wl.SparseOperator(scipy.sparse.csr_array(M), **options),
    ):
        for scale, message in (
            (1e39, "matrix holds values up to"),
            (1e-60, "matrix, the largest entries of its rows: 2 are not 0"),
        ):
            with pytest.raises(ValueError, match=message):
                make(scale * A, dtype=wp.float32, device="cpu")
            assert wl.solve(wl.LCP(make(scale * A, device="cpu"), scale * B), wl.Lemke())
    with pytest.raises(ValueError, match=r"columns holds values up to 1.0e\+39"):
        wl.LowRankOperator(np.full((2, 1), 1e39), np.ones(1), dtype=wp.float32)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ((1e39, np.inf), r"lower: x must be 1.0e\+39"),
        ((-np.inf, -1e39), r"upper: x must be -1.0e\+39"),
    ],
)
def test_bounds_beyond_single_precision(bounds, message):
    problem = wl.LCP(A, B, *bounds)
    with pytest.raises(
        ValueError, match=message + ", too large for precision='single': use 'mixed'"
    ):
        wl.solve(problem, wl.ProjectedSOR(precision="single"))
    assert wl.solve(problem, wl.ProjectedSOR(precision="mixed"))
    # A bound beyond all x is no bound.
    assert wl.solve(wl.LCP(A, B, 0.0, 1e39), wl.ProjectedSOR(precision="single"))


def test_operators_that_lack_members():
    members = {name for name in vars(wl.Operator) if not name.startswith("_")} | set(
        wl.Operator.__annotations__
    )
    assert set(names_of(wl.Operator)) == members

    class IncompleteOperator:
        shape, dtype, symmetric = (2,), wp.float64, True

        def apply(self, x, out=None):
            raise AssertionError

    with pytest.raises(
        ValueError,
        match=r"A is a IncompleteOperator without device, apply_transpose, diagonal: "
        r"an operator needs them; a subclass of",
    ):
        wl.LCP(IncompleteOperator(), B)


def test_methods_by_name():
    with pytest.raises(KeyError, match="no such method: 'lemk'; did you mean 'lemke'"):
        wl.METHODS["lemk"]
    with pytest.raises(KeyError, match=r"no such method: 'foo'; choose from .*, lemke, .*, psor"):
        wl.METHODS["foo"]
    meant = {
        "ipm": "interior-point",
        "PGS": "psor",
        "qp": "quadratic-program",
        "InteriorPoint": "interior-point",
        "apg": "accelerated.*",
    }
    for name, method in meant.items():
        with pytest.raises(KeyError, match=f"no such method: '{name}'; did you mean '{method}'"):
            wl.METHODS[name]
    for name, method in wl.METHODS.items():
        assert wl.METHODS.nearest(method.__name__) == f"did you mean {name!r}?"
    for name in wl.METHODS:
        initials = "".join(word[0] for word in name.split("-"))
        # "ip" is that of two methods, "pgs" that of projected Gauss-Seidel, which is "psor" here.
        if len(initials) > 1 and name not in ("interior-point", "proximal-gauss-seidel"):
            assert wl.METHODS.nearest(initials) == f"did you mean {name!r}?"
    with pytest.raises(
        ValueError, match=r"method = 'ipm': must be one of .*; did you mean 'interior-point'"
    ):
        wl.linear_complementarity(np.eye(2), np.ones(2), method="ipm")
    assert wl.METHODS.get("foo") is None
    assert "foo" not in wl.METHODS


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (
            {"rtol": 1e-8},
            r"solve takes no rtol: it is a stopping criterion, pass "
            r"stopping=wl.StoppingCriteria\(rtol=...\)",
        ),
        ({"max_seconds": 1.0}, r"pass stopping=wl.StoppingCriteria\(max_seconds=...\)"),
        ({"omega": 1.5}, "solve takes no omega: it is a setting of a method"),
        ({"tolerance": 1e-6}, r"stopping=wl.StoppingCriteria\(rtol=...\)"),
        ({"maxiter": 9}, r"stopping=wl.StoppingCriteria\(max_iterations=...\)"),
    ],
)
def test_options_that_belong_elsewhere(option, message):
    with pytest.raises(TypeError, match=message):
        wl.solve(wl.LCP(A, B), **option)
