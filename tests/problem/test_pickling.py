"""Pickles and copies of problems, operators and results.

The same answers, bit for bit, and separate memory.
"""

import copy
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse
import warp as wp

import warp_lcp as wl


def again_by_pickle(value):
    return pickle.loads(pickle.dumps(value))


CELLS = np.ones((6, 9), dtype=int)
CELLS[-1], CELLS[2, 3:5] = wl.AIR, wl.SOLID


def grid(device, **options):
    return wl.GridPoisson(CELLS, **options, device=device)


def columns():
    U = np.zeros((*CELLS.shape, 2))
    U[1, 2:5, 0], U[3, 1:3, 1] = 1.0, [0.5, -1.0]
    return U


def with_bodies(device):
    return wl.SumOperator(
        grid(device),
        wl.LowRankOperator(columns(), np.array([[2.0, 0.5], [0.5, 1.0]]), device=device),
    )


def in_place(device):
    A = grid(device)
    b, low = (wp.zeros(A.layout.stored_shape, dtype=wp.float64, device=device) for _ in range(2))
    b.assign(np.pad(np.random.default_rng(3).standard_normal((1, *CELLS.shape)), 1))
    return wl.LCP(A, b, low)


def field(seed=11):
    return np.random.default_rng(seed).standard_normal(CELLS.shape)


def matrix(n=30):
    return scipy.sparse.diags_array([-1.0, 2.5, -1.2], offsets=[-1, 0, 1], shape=(n, n)).tocsr()


FACES = {
    "face_x": np.linspace(0.5, 1.0, 60).reshape(6, 10),
    "face_y": 0.7,
    "shift": np.full(CELLS.shape, 0.1),
}
WALLS = np.where(np.arange(9) < 4, 0.0, -np.inf) * np.ones(CELLS.shape)
PROBLEMS = {
    "dense": lambda device: wl.LCP(
        wl.DenseOperator(matrix().toarray(), device=device),
        np.linspace(-1, 1, 30),
        -0.25,
        np.full(30, 0.1),
    ),
    "float32": lambda device: wl.LCP(
        wl.SparseOperator(matrix(), device=device, dtype=wp.float32), np.linspace(-1, 1, 30)
    ),
    "sparse": lambda device: wl.LCP(
        wl.SparseOperator(matrix(), device=device), np.linspace(-1, 1, 30), np.linspace(-1, 0, 30)
    ),
    "grid": lambda device: wl.LCP(grid(device), field(), WALLS),
    "faces": lambda device: wl.LCP(
        grid(device, **FACES, dtype=wp.float64), field(), field(12) - 3.0, field(12) + 0.1
    ),
    "periodic": lambda device: wl.LCP(
        wl.GridPoisson(
            np.ones((4, 6), dtype=int), periodic=(True, False), shift=1.0, device=device
        ),
        -np.ones((4, 6)),
    ),
    "bodies": lambda device: wl.LCP(with_bodies(device), field()),
    "in place": in_place,
    "friction": lambda device: wl.LCP(
        wl.DenseOperator(np.eye(2), device=device),
        -np.ones(2),
        *wl.AffineBounds.friction([-1, 0], 0.5),
    ),
}


@pytest.mark.parametrize("make_copy", [again_by_pickle, copy.deepcopy, copy.copy])
@pytest.mark.parametrize("name", PROBLEMS)
def test_problems(name, make_copy, device):
    problem = PROBLEMS[name](device)
    twin = make_copy(problem)
    assert twin.device == problem.device
    assert (type(twin.A), twin.A.dtype, twin.A.shape) == (
        type(problem.A),
        problem.A.dtype,
        problem.A.shape,
    )
    assert (twin.in_place, twin.bounds.in_place, bool(twin.bounds.code.size)) == (
        problem.in_place,
        problem.bounds.in_place,
        bool(problem.bounds.code.size),
    )
    first, second = wl.solve(problem), wl.solve(twin)
    assert first
    assert first.history[-1].residual == second.history[-1].residual
    np.testing.assert_array_equal(first.x.numpy(), second.x.numpy())
    twin.b.fill_(7.0)
    assert (problem.b.numpy() == 7.0).any() == (make_copy is copy.copy)


@pytest.mark.parametrize("make_copy", [again_by_pickle, copy.deepcopy])
def test_results(make_copy, device):
    result = wl.solve(PROBLEMS["grid"](device))
    twin = make_copy(result)
    assert twin
    assert twin.x.device == result.x.device
    assert twin.x.ptr != result.x.ptr
    np.testing.assert_array_equal(twin.x.numpy(), result.x.numpy())
    for name in (
        "status",
        "iterations",
        "linear_iterations",
        "residual",
        "relative_residual",
        "history",
    ):
        assert getattr(twin, name) == getattr(result, name)
    batch = make_copy(wl.enumerate_batch(np.eye(2)[None], -np.ones((1, 2)), device=device))
    np.testing.assert_array_equal(batch.x.numpy(), [[1.0, 1.0]])


def test_statuses_are_pickled_by_name():
    """Statuses by their names, since their messages may change between versions."""
    for status in wl.SolveStatus:
        assert again_by_pickle(status) is status
        assert status.value.encode() not in pickle.dumps(status)


def test_a_device_that_is_missing_becomes_the_cpu(device):
    result = wl.solve(PROBLEMS["dense"](device))
    elsewhere = pickle.dumps(result).replace(
        result.x.device.alias.encode(), b"xpu"[: len(result.x.device.alias)]
    )
    assert pickle.loads(elsewhere).x.device == wp.get_device("cpu")


def test_objects_that_cannot_be_pickled_name_an_alternative(device):
    A = grid(device)
    with pytest.raises(TypeError, match="pickle the operator it was made from, and mask it again"):
        pickle.dumps(A.masked(np.ones(CELLS.shape)))
    A.layout.comm = SimpleNamespace()
    with pytest.raises(
        TypeError,
        match="GridPoisson is distributed over ranks and cannot be pickled: pickle its cells and "
        "coefficients on each rank",
    ):
        copy.deepcopy(A)
