"""Gradients of `wl.vjp` on Warp's tape, in PyTorch and in JAX."""

import contextlib
import importlib
from functools import partial

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp.extras.gradients import jax as with_jax
from warp_lcp.extras.gradients import pytorch, tape

SEED = 127
OPTIONS = {"stopping": wl.StoppingCriteria(rtol=1e-12), "adjoint": wl.StoppingCriteria(rtol=1e-12)}


def data():
    rng = np.random.default_rng(SEED)
    cells = rng.choice([wl.AIR, wl.FLUID], (8, 9), p=[0.2, 0.8])
    fields = {
        "b": rng.standard_normal(cells.shape),
        "lower": -0.2 * rng.random(cells.shape),
        "face_x": rng.uniform(0.5, 2.0, (8, 10)),
    }
    return (
        cells,
        partial(wl.GridPoisson, cells, device="cpu", dtype=wp.float64),
        fields,
        rng.standard_normal(cells.shape),
    )


def expected():
    """Return x, and the gradients of g.x + |x|^2 / 2."""
    _, make, fields, g = data()
    result = wl.solve(
        wl.LCP(make(face_x=fields["face_x"]), fields["b"], fields["lower"]),
        stopping=OPTIONS["stopping"],
    )
    return result.x.numpy(), wl.vjp(
        result, g + result.x.numpy(), stopping=OPTIONS["adjoint"]
    ).by_name


@wp.kernel(module="warp_lcp.tests.gradients")
def loss_kernel(
    x: wp.array2d(dtype=wp.float64),
    g: wp.array2d(dtype=wp.float64),
    loss: wp.array(dtype=wp.float64),
):
    k, j = wp.tid()
    wp.atomic_add(loss, 0, g[k, j] * x[k, j] + wp.float64(0.5) * x[k, j] * x[k, j])


@wp.kernel(module="warp_lcp.tests.gradients")
def double_kernel(half: wp.array2d(dtype=wp.float64), whole: wp.array2d(dtype=wp.float64)):
    k, j = wp.tid()
    whole[k, j] = wp.float64(2.0) * half[k, j]


def test_tapes():
    """Tapes: a kernel before the solve, and one after it.

    Gradients accumulate and can be zeroed.
    """
    cells, make, fields, g = data()
    x, found = expected()
    arrays = {
        name: wp.array(v, dtype=wp.float64, device="cpu", requires_grad=True)
        for name, v in fields.items()
    }
    half = wp.array(0.5 * fields["b"], dtype=wp.float64, device="cpu", requires_grad=True)
    record = wp.Tape()
    with record:
        wp.launch(double_kernel, cells.shape, [half], [arrays["b"]], device="cpu")
    result = tape.solve(
        record,
        make,
        arrays["b"],
        arrays["lower"],
        coefficients={"face_x": arrays["face_x"]},
        **OPTIONS,
    )
    loss = wp.zeros(1, dtype=wp.float64, device="cpu", requires_grad=True)
    with record:
        wp.launch(
            loss_kernel,
            cells.shape,
            [result.x, wp.array(g, dtype=wp.float64, device="cpu"), loss],
            device="cpu",
        )
    assert len(record.launches) == 3
    assert np.array_equal(result.x.numpy(), x)
    for _ in range(2):
        record.backward(loss)
        for name in ("lower", "face_x"):
            assert np.allclose(arrays[name].grad.numpy(), found[name].numpy(), atol=1e-12)
        # A kernel that writes b receives its gradient.
        assert np.allclose(half.grad.numpy(), 2 * found["b"].numpy(), atol=1e-12)
        record.zero()
        assert not arrays["face_x"].grad.numpy().any()


def test_gradients_on_a_tape_are_of_the_types_given_and_added_up():
    _, make, fields, g = data()
    record, b = wp.Tape(), wp.array(fields["b"], dtype=wp.float32, device="cpu", requires_grad=True)
    results = [tape.solve(record, make(), b, lower, **OPTIONS) for lower in (-0.1, -np.inf)]
    record.backward(
        grads={result.x: wp.array(g, dtype=wp.float64, device="cpu") for result in results}
    )
    separate = [wl.vjp(result, g, stopping=OPTIONS["adjoint"]).b.numpy() for result in results]
    assert np.allclose(b.grad.numpy(), sum(separate), rtol=1e-5, atol=1e-6)


def stencil(given):
    """Return an unsymmetric stencil's coefficients, as a function of two of them."""
    center, east = given
    return {
        "coefficients": {(0, 0): center, (0, 1): east, (0, -1): -0.5, (1, 0): -1.0, (-1, 0): -1.0}
    }


def test_coefficients_of_stencils():
    """Coefficients of stencils as a mapping, on tapes, in PyTorch and in JAX.

    Its arrays have gradients of their own.
    """
    cells, _, fields, g = data()
    make, values = (
        partial(wl.Stencil, cells, device="cpu", dtype=wp.float64),
        (np.full(cells.shape, 5.0), -fields["face_x"][:, 1:]),
    )
    problem = wl.LCP(make(**stencil(values)), fields["b"], fields["lower"])
    found = wl.vjp(
        wl.solve(problem, stopping=OPTIONS["stopping"]), g, stopping=OPTIONS["adjoint"]
    ).coefficients["coefficients"]
    expected = [found[0, 0].numpy(), found[0, 1].numpy()]

    record, arrays = (
        wp.Tape(),
        [wp.array(v, dtype=wp.float64, device="cpu", requires_grad=True) for v in values],
    )
    result = tape.solve(
        record, make, fields["b"], fields["lower"], coefficients=stencil(arrays), **OPTIONS
    )
    record.backward(grads={result.x: wp.array(g, dtype=wp.float64, device="cpu")})
    np.testing.assert_allclose([array.grad.numpy() for array in arrays], expected, atol=1e-12)
    sides = fields["b"], fields["lower"]
    with contextlib.suppress(ImportError):
        torch = importlib.import_module("torch")
        tensors = [torch.tensor(v, requires_grad=True) for v in values]
        of_torch = pytorch.solve(
            make, *map(torch.tensor, sides), coefficients=stencil(tensors), **OPTIONS
        )
        (torch.tensor(g) * of_torch).sum().backward()
        np.testing.assert_allclose(
            [tensor.grad.numpy() for tensor in tensors], expected, atol=1e-12
        )
    with contextlib.suppress(ImportError):
        jax = importlib.import_module("jax")
        with jax.enable_x64(True):

            def loss(*given):
                x = with_jax.solve(make, *sides, coefficients=stencil(given), **OPTIONS)
                return (g * x).sum()

            np.testing.assert_allclose(
                jax.grad(loss, argnums=(0, 1))(*values), expected, atol=1e-10
            )


def test_pytorch():
    torch = pytest.importorskip("torch", reason="PyTorch is missing")
    _, make, fields, g = data()
    x, found = expected()
    tensors = {name: torch.tensor(v, requires_grad=True) for name, v in fields.items()}
    solution = pytorch.solve(
        make, tensors["b"], tensors["lower"], coefficients={"face_x": tensors["face_x"]}, **OPTIONS
    )
    assert np.array_equal(solution.detach().numpy(), x)
    ((torch.tensor(g) * solution).sum() + 0.5 * (solution**2).sum()).backward()
    for name, tensor in tensors.items():
        assert np.allclose(tensor.grad.numpy(), found[name].numpy(), atol=1e-12)
    numbers = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (-0.15, 0.7)]
    single = torch.tensor(fields["b"], dtype=torch.float32, requires_grad=True)

    def of(lower, face_y):
        return pytorch.solve(
            make, tensors["b"], lower, coefficients={"face_y": face_y}, **OPTIONS
        ).sum()

    assert torch.autograd.gradcheck(of, numbers, eps=1e-6, atol=1e-6)
    pytorch.solve(make(), single, -0.1, stopping=OPTIONS["stopping"]).sum().backward()
    assert single.grad.dtype == torch.float32
    with pytest.raises(ArithmeticError, match="MAX_ITERATIONS"):
        pytorch.solve(make(), single, stopping=wl.StoppingCriteria(rtol=1e-12, max_iterations=1))


def test_jax():
    jax = pytest.importorskip("jax", reason="JAX is missing")
    _, make, fields, g = data()
    x, found = expected()

    def loss(b, lower, face_x):
        solution = with_jax.solve(make, b, lower, coefficients={"face_x": face_x}, **OPTIONS)
        return (g * solution).sum() + 0.5 * (solution**2).sum(), solution

    with jax.enable_x64(True):
        values = [jax.numpy.asarray(fields[name]) for name in ("b", "lower", "face_x")]
        (_, solution), gradients = jax.jit(
            jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)
        )(*values)
    assert np.allclose(solution, x, atol=1e-13)
    for name, gradient in zip(("b", "lower", "face_x"), gradients, strict=True):
        assert np.allclose(gradient, found[name].numpy(), atol=1e-10)
    single = jax.grad(
        lambda b: with_jax.solve(make(), b, -0.1, stopping=wl.StoppingCriteria(rtol=1e-5)).sum()
    )(fields["b"])
    assert single.dtype == np.float32
