"""Test matrices as NumPy and SciPy arrays, and the problems posed with them."""

import numpy as np
import scipy.sparse

import warp_lcp as wl


def spd(n, seed, shift):
    """Return a random symmetric positive definite matrix, shape (n, n).

    Its eigenvalues are at least `shift`.
    """
    B = np.random.default_rng(seed).standard_normal((n, n))
    return B @ B.T / n + shift * np.eye(n)


def poisson(*counts):
    """Return the Laplacian stencil in d = len(counts) dimensions as a CSR matrix.

    The diagonal is 2 d, the weight of each neighbor -1; values outside the grid are 0.
    """
    A = scipy.sparse.csr_array((1, 1))
    for n in counts:
        T = scipy.sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n))
        A = scipy.sparse.kron(A, scipy.sparse.eye_array(n)) + scipy.sparse.kron(
            scipy.sparse.eye_array(A.shape[0]), T
        )
    return scipy.sparse.csr_array(A)


def laplacian(n, diagonal=2.0):
    """Return the five-point stencil on n x n points as a CSR matrix.

    The diagonal is twice `diagonal`, the weight of each neighbor -1.
    """
    T, one = (
        scipy.sparse.diags_array([-1.0, diagonal, -1.0], offsets=[-1, 0, 1], shape=(n, n)),
        scipy.sparse.eye_array(n),
    )
    return scipy.sparse.csr_array(scipy.sparse.kron(one, T) + scipy.sparse.kron(T, one))


def dense_and_sparse(A, device):
    """Return the dense and the sparse operator of a matrix."""
    return wl.DenseOperator(A, device=device), wl.SparseOperator(
        scipy.sparse.csr_array(A), device=device
    )


def posed(A, b, kind, lower=0.0, upper=np.inf):
    """Return the LCP of a matrix, as an operator of kind "dense" or "sparse"."""
    return wl.LCP(operator_of(A, kind), b, lower, upper)


def posed_dense(A, b, lower=0.0, upper=np.inf):
    """Return the LCP of a dense matrix."""
    return posed(A, b, "dense", lower, upper)


def operator_of(A, kind, device="cpu"):
    """Return the operator of a matrix, of kind "dense" or "sparse"."""
    if kind == "dense":
        return wl.DenseOperator(A, device=device)
    return wl.SparseOperator(scipy.sparse.csr_array(A), device=device)


def solve_matrix(A, b, lower=0.0, upper=np.inf, solver=None, **options):
    """Solve the LCP of a matrix on the CPU, sparse as a SciPy matrix and dense as an array.

    `solver` is the method; `options` are those of `wl.solve`.
    """
    kind = "sparse" if scipy.sparse.issparse(A) else "dense"
    return wl.solve(posed(A, b, kind, lower, upper), solver, **options)


def planted_solution(A, rng, share):
    """Return b and a strictly complementary solution x of A x + b = y.

    `share` is the probability that an unknown is at its bound 0.
    """
    held = rng.random(len(A)) < share
    x = np.where(held, 0.0, rng.uniform(0.1, 1.0, len(A)))
    return np.where(held, rng.uniform(0.1, 1.0, len(A)), 0.0) - A @ x, x
