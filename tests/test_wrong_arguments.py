"""What a user may pass by mistake: each is a ValueError that names the argument, whatever it is."""

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl

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
    with pytest.raises(ValueError, match="SparseOperator takes it"):
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
        ({"solver": "lemke"}, "solver is a str"),
        ({"solver": wl.Lemke}, "solver is the class Lemke"),
        ({"stopping": 1e-6}, "stopping is a float"),
        ({"x0": 0.0}, r"x0 has shape \(\)"),
        ({"x0": "zero"}, "x0 is a str"),
        ({"x0": [0.0, np.nan]}, "x0 holds 1 values that are not finite"),
        ({"x0": [1e300, 1e300]}, "x0 gives a residual that is not finite"),
    ],
)
def test_solves(options, message, device):
    with pytest.raises(ValueError, match=message):
        wl.solve(wl.LCP(wl.DenseOperator(A, device=device), B), **options)


def test_a_matrix_is_no_problem():
    with pytest.raises(ValueError, match="problem is a ndarray: expected an LCP"):
        wl.solve(A, wl.Lemke())


OPERATORS = {
    "dense": lambda device: wl.LCP(wl.DenseOperator(A, device=device), B),
    "sparse": lambda device: wl.LCP(wl.SparseOperator(scipy.sparse.csr_array(A), device=device), B),
    "grid": lambda device: wl.LCP(wl.GridPoisson(np.array([[1, 1, 0]]), device=device), np.array([[0.5, -2.5, 0.0]])),
}


@pytest.mark.parametrize("name", wl.METHODS)
def test_workspaces_of_another_method_problem_or_kind_are_refused(name, device):
    """A workspace that is taken for another's gives an AttributeError in the middle of a solve, or the other method's iterates."""
    method = wl.METHODS[name]()
    if name == "quadratic-program":
        pytest.importorskip("piqp")
    for family in wl.METHODS[name].supports:
        problem, twin = (OPERATORS[family](device) for _ in range(2))
        assert wl.solve(problem, method, workspace=method.init(problem), stopping=wl.StoppingCriteria(rtol=0.5))
        with pytest.raises(ValueError, match="workspace was made for another problem"):
            wl.solve(problem, method, workspace=method.init(twin))
        for other, cls in wl.METHODS.items():
            shared = (name, other) == ("blocked-gauss-seidel", "staggering")  # two blocks are staggered
            if other not in (name, "quadratic-program") and family in cls.supports and not shared:
                with pytest.raises(ValueError, match=f"workspace is a .*: expected what {type(method).__name__}"):
                    wl.solve(problem, method, workspace=cls().init(problem))
    for wrong in ({}, 3, "work", type(method.init(problem)), problem, np.zeros(2)):
        with pytest.raises(ValueError, match="workspace is "):
            wl.solve(problem, method, workspace=wrong)


@pytest.mark.parametrize("setting", [{"max_iterations": 1.5}, {"max_iterations": -1}, {"patience": 0}, {"patience": float("nan")}])
def test_limits_are_integers(setting):
    with pytest.raises(ValueError, match=f"{next(iter(setting))} = .*: must be an integer >= "):
        wl.StoppingCriteria(**setting)


@pytest.mark.parametrize("name", [name for name, cls in wl.METHODS.items() if "precision" in cls.__dataclass_fields__])
def test_precision_is_named(name):
    with pytest.raises(ValueError, match=r"precision = 'half': must be 'mixed', 'single' or 'double'"):
        wl.METHODS[name](precision="half")


@pytest.mark.parametrize(
    "made",
    [
        lambda device: (A, B),
        lambda device: (A.astype(np.float32), B),
        lambda device: (np.asfortranarray(A), np.repeat(B, 2)[::2]),
        lambda device: ((2 * A).astype(int), [1, -5]),
        lambda device: (wp.array(A, dtype=wp.float32, device=device), wp.array(B, dtype=wp.float64, device=device)),
        lambda device: (wp.array(A, dtype=wp.float64, device=device), wp.array(B, dtype=wp.float32, device=device)),
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
