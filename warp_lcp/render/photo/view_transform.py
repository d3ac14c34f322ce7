"""AgX view transform: scene-linear radiance to display code values.

Sobotka's AgX (2022) with the constants of Wrensch, "Minimal AgX implementation" (2023). Rec. 709
colors are mixed by an inset matrix, so that bright saturated light turns white instead of clipping
to a primary. They are encoded as log2 over 16.5 stops around middle grey 0.18, and mapped by a
sigmoid per channel, linear about middle grey, with a power toe and a power shoulder.
"""

from __future__ import annotations

import numpy as np

MIDDLE_GREY = 0.18  # scene-linear
STOPS = -10.0, 6.5  # below and above middle grey
PIVOT_OUTPUT = 0.5  # code value of middle grey
SLOPE = 2.0  # slope of the sigmoid at middle grey
TOE, SHOULDER = 3.0, 3.25  # powers: greater ones bend later and more sharply
INSET = np.array(
    [
        [0.842479062253094, 0.0784335999999992, 0.0792237451477643],
        [0.0423282422610123, 0.878468636469772, 0.0791661274605434],
        [0.0423756549057051, 0.0784336, 0.879142973793104],
    ]
)
LUMA = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709


def agx(radiance: np.ndarray, *, contrast: float = 1.0, saturation: float = 1.0) -> np.ndarray:
    """Return display code values in [0, 1] of scene-linear Rec. 709 radiance.

    Args:
        radiance: shape (..., 3); negative values count as 0.
        contrast: power of the code values after the sigmoid: c^contrast.
        saturation: factor on the distance of the colors from their luma, after the sigmoid.
    """
    mixed = np.maximum(radiance, 0.0) @ INSET.T
    low, high = STOPS
    stops = np.log2(np.maximum(mixed, 1e-30) / MIDDLE_GREY)
    code = sigmoid((np.clip(stops, low, high) - low) / (high - low))
    code = np.clip(code, 0.0, 1.0) ** contrast  # rounding leaves black slightly below 0
    luma = (code @ LUMA)[..., None]
    code = luma + saturation * (code - luma)
    return np.clip(code @ np.linalg.inv(INSET).T, 0.0, 1.0)


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Return the tone curve of log-encoded values in [0, 1].

    f(0) = 0, f(pivot) = 1/2 with slope `SLOPE`, f(1) = 1.
    """
    low, high = STOPS
    pivot = -low / (high - low)
    toe = _branch(pivot - x, pivot, PIVOT_OUTPUT, TOE)
    shoulder = _branch(x - pivot, 1.0 - pivot, 1.0 - PIVOT_OUTPUT, SHOULDER)
    return np.where(x < pivot, PIVOT_OUTPUT - toe, PIVOT_OUTPUT + shoulder)


def _branch(distance: np.ndarray, reach: float, rise: float, power: float) -> np.ndarray:
    """Return s u / (1 + u^p)^(1/p), u = SLOPE distance / s.

    The scale s is such that the value at `reach` equals `rise`.
    """
    scale = SLOPE * reach * ((SLOPE * reach / rise) ** power - 1.0) ** (-1.0 / power)
    u = SLOPE * np.maximum(distance, 0.0) / scale
    return scale * u / (1.0 + u**power) ** (1.0 / power)
