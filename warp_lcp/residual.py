"""The natural residual, the one number in which all methods are compared; always evaluated from x in float64.

r_i = d_i (x_i - clip(x_i - y_i / d_i, l_i, u_i)) with d_i = |A_ii|, 1 where that is 0. r has the units of y and does not change when x is
rescaled; it vanishes exactly at solutions.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.native import Spans
from warp_lcp.problem import LCP
from warp_lcp.vectors import Reduction, flat, launch_spans, span_end, span_start


@functools.cache
def kernels(d_type: Any) -> SimpleNamespace:
    """Return the kernels for a diagonal of this type."""
    name = f"warp_lcp.residual.{d_type.__name__}"
    f64, i8, d_array = wp.array(dtype=wp.float64), wp.array(dtype=wp.int8), wp.array(dtype=d_type)

    @wp.func_native(
        flat(
            """const double *x = x_.data, *y = y_.data, *l = l_.data, *u = u_.data; const auto* d = d_.data; const auto* m = m_.data;
        double s = 0;
        EACH {
            const double a = unit*(double)d[i], b = a < 0 ? -a : a, e = b == 0 ? 1.0 : b, v = x[i] - y[i]/e;
            const double w = v < l[i] ? l[i] : v, c = w > u[i] ? u[i] : w, r = m[i] == 1 ? e*(x[i] - c) : 0.0;
            s += r*r; }
        return s;"""
        )
    )
    def natural_span(
        x_: f64, y_: f64, d_: d_array, unit: wp.float64, l_: f64, u_: f64, m_: i8, start: wp.int64, end: wp.int64, stride: wp.int64
    ) -> wp.float64: ...

    @wp.kernel(enable_backward=False, module=name)
    def natural(
        x: f64, y: f64, d: d_array, unit: wp.float64, lower: f64, upper: f64, unknown: i8, n: int, chunk: int, stride: wp.int64, out: f64
    ):
        t = wp.tid()
        out[t] = natural_span(x, y, d, unit, lower, upper, unknown, span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(natural=natural)


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def masked_square_kernel(
    b: wp.array(dtype=wp.float64),
    unknown: wp.array(dtype=wp.int8),
    n: int,
    chunk: int,
    stride: wp.int64,
    out: wp.array(dtype=wp.float64),
):
    """Partial sums of b.b over the unknowns."""
    t = wp.tid()
    s = wp.float64(0.0)
    i = span_start(t, chunk)
    end = span_end(t, chunk, n)
    while i < end:
        if unknown[i] == wp.int8(1):
            s += b[i] * b[i]
        i += stride
    out[t] = s


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def start_kernel(
    x: wp.array(dtype=wp.float64),
    lower: wp.array(dtype=wp.float64),
    upper: wp.array(dtype=wp.float64),
    unknown: wp.array(dtype=wp.int8),
    keep: bool,
):
    """Clip(x, l, u), or clip(0, l, u), on the unknowns; 0 elsewhere."""
    i = wp.tid()
    v = wp.float64(0.0)
    if unknown[i] == wp.int8(1):
        if keep:
            v = x[i]
        v = wp.min(wp.max(v, lower[i]), upper[i])
    x[i] = v


@wp.kernel(enable_backward=False, module="warp_lcp.residual")
def add_kernel(b: wp.array(dtype=wp.float64), y: wp.array(dtype=wp.float64)):
    """Y += b."""
    i = wp.tid()
    y[i] = y[i] + b[i]


class NaturalResidual:
    """Evaluates y = A x + b and the norm of the natural residual, in float64.

    Attributes:
        y: stored field, A x + b at the x of the last evaluation.
        norm: the residual's norm there, units of y.
        current: whether `y` and `norm` belong to the iterate as it is; a method that moves x sets it to False.
    """

    def __init__(self, problem: LCP) -> None:
        self.problem = problem
        layout = problem.layout
        self.y = layout.zeros(wp.float64)
        self.norm, self.current = 0.0, False
        stencil = getattr(problem.A, "stencil", None)
        self.diagonal = stencil.d if stencil else layout.load(problem.A.diagonal(), problem.A.dtype)
        self.unit = float(stencil.unit) if stencil else 1.0
        self._sums = wp.zeros(2, dtype=wp.float64, device=layout.device)
        self._reduction = Reduction(layout.size, layout.device, self._sums)

    def evaluate(self, x: wp.array[Any]) -> float:
        """Compute y and return the norm of the natural residual at x (stored, float64)."""
        p = self.problem
        self.affine(x)
        before = [x, self.y, self.diagonal, self.unit, p.lower, p.upper, p.unknown]
        spans, partials = self._reduction.spans, self._reduction.partials
        launch_spans(kernels(self.diagonal.dtype).natural, spans, before, [partials], p.device)
        self._reduction.add_up(0)
        self.norm, self.current = float(np.sqrt(self._sums.numpy()[0])), True
        return self.norm

    def affine(self, x: wp.array[Any]) -> None:
        """Set y = A x + b."""
        A, p = self.problem.A, self.problem
        apply_plus = getattr(A, "apply_plus", None)
        if apply_plus is not None:
            apply_plus(x, p.b, self.y)
            return
        A.apply(x.reshape(p.layout.stored_shape), self.y.reshape(p.layout.stored_shape))
        wp.launch(add_kernel, x.size, [p.b, self.y], device=p.device)

    def start(self, x: wp.array[Any], *, keep: bool) -> None:
        """Set x to clip(x, l, u), or to clip(0, l, u), and to 0 where there is no unknown."""
        p = self.problem
        wp.launch(start_kernel, x.size, [x, p.lower, p.upper, p.unknown, keep], device=p.device)
        self.current = False

    def norm_of_b(self) -> float:
        """Return ||b|| over the unknowns."""
        p, s = self.problem, self._reduction.spans
        launch_spans(masked_square_kernel, s, [p.b, p.unknown], [self._reduction.partials], p.device)
        self._reduction.add_up(1)
        return float(np.sqrt(self._sums.numpy()[1]))

    def rounding_floor(self, x: wp.array[Any], epsilon: float) -> float:
        """Return an estimate of the residual that rounding x to `epsilon` leaves: epsilon || 2 |d x| + |b| ||."""
        inside = self.problem.unknown.numpy() == 1
        d = np.abs(self.diagonal.numpy()[inside].astype(np.float64)) * self.unit
        return float(epsilon * np.linalg.norm(2 * d * np.abs(x.numpy()[inside]) + np.abs(self.problem.b.numpy()[inside])))


def spans_of(problem: LCP) -> Spans:
    """Return how flat kernels share out the problem's fields."""
    return Spans.of(problem.layout.size, problem.device)
