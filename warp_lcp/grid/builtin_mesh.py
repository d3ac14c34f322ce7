"""Closed surfaces that need no file: tubes around closed curves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]


def tube(curve: np.ndarray, normals: np.ndarray, binormals: np.ndarray, radius: float, sides: int) -> Mesh:
    """Build the closed tube around a closed curve, oriented outward.

    Args:
        curve: points along the curve, shape (n, 3); the last is joined to the first.
        normals: unit vectors across the curve, shape (n, 3).
        binormals: tangent x normal, shape (n, 3).
        radius: of the tube, less than the curve's radius of curvature and half the distance of its strands.
        sides: number of vertices around the tube.

    Returns:
        Vertices of shape (n * sides, 3) and triangles of shape (2 * n * sides, 3).
    """
    angle = 2.0 * np.pi * np.arange(sides) / sides
    across = np.cos(angle)[:, None] * normals[:, None] + np.sin(angle)[:, None] * binormals[:, None]
    vertices = (curve[:, None] + radius * across).reshape(-1, 3)
    along, around = np.meshgrid(np.arange(len(curve)), np.arange(sides), indexing="ij")
    a = along * sides + around
    b = (along + 1) % len(curve) * sides + around
    c = (along + 1) % len(curve) * sides + (around + 1) % sides
    d = along * sides + (around + 1) % sides
    triangles = np.concatenate([np.stack([a, c, b], axis=-1).reshape(-1, 3), np.stack([a, d, c], axis=-1).reshape(-1, 3)])
    return vertices, triangles


def torus() -> Mesh:
    """Build a torus about the z axis: radius 0.35 around, 0.15 of the tube; it fills [-0.5, 0.5] x [-0.5, 0.5] x [-0.15, 0.15]."""
    t = 2.0 * np.pi * np.arange(96) / 96
    zero = np.zeros_like(t)
    normals = np.stack([np.cos(t), np.sin(t), zero], axis=-1)
    tangents = np.stack([-np.sin(t), np.cos(t), zero], axis=-1)
    return tube(0.35 * normals, normals, np.cross(tangents, normals), 0.15, 48)


def knot() -> Mesh:
    """Build a trefoil knot of round tube: the curve (sin t + 2 sin 2t, cos t - 2 cos 2t, -sin 3t), scaled to a largest extent of 1."""
    t = 2.0 * np.pi * np.arange(240) / 240
    curve = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=-1)
    first = np.stack([np.cos(t) + 4 * np.cos(2 * t), -np.sin(t) + 4 * np.sin(2 * t), -3 * np.cos(3 * t)], axis=-1)
    second = np.stack([-np.sin(t) - 8 * np.sin(2 * t), -np.cos(t) + 8 * np.cos(2 * t), 9 * np.sin(3 * t)], axis=-1)
    binormals = np.cross(first, second)  # never zero on this curve, so Frenet's frame closes without a seam
    binormals /= np.linalg.norm(binormals, axis=1, keepdims=True)
    tangents = first / np.linalg.norm(first, axis=1, keepdims=True)
    normals = np.cross(binormals, tangents)
    vertices, triangles = tube(curve, normals, binormals, KNOT_TUBE, 24)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return (vertices - 0.5 * (low + high)) / (high - low).max(), triangles


KNOT_TUBE = 0.5
BUILTIN: dict[str, Callable[[], Mesh]] = {"torus": torus, "knot": knot}
