"""Water drawn over an image: bent light, the color of its depth, mirrored sky. Runs on the CPU, layer by layer."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.render import water_kernels as kernels
from warp_lcp.scene.camera import Viewpoint
from warp_lcp.simulation import Surface

FAR = float(kernels.FAR)  # a depth [m]
LAYERS = 3  # of water behind each other, from the nearest, that are drawn
ABSORPTION = np.array([15.0, 5.5, 3.2])  # over the domain's longest side: a bucket and a harbor look the same in their images
DEEP = np.array([0.010, 0.13, 0.30])  # linear, as all colors of the kernels
HAZE = np.array([0.20, 0.34, 0.46])
SMOOTHINGS = 2  # of the normals, each over the neighboring points


def draw_water(surface: Surface, image: np.ndarray, depth: np.ndarray, view: Viewpoint, *, size: float, light: np.ndarray) -> np.ndarray:
    """Return an image with water drawn over it.

    Args:
        surface: of the water, triangles.
        image: without water, red, green and blue from 0 to 255, shape (height, width, 3).
        depth: of what is in the image along the line of sight [m], inf where there is nothing, shape (height, width).
        view: what the image was drawn from.
        size: the domain's longest side [m], over which light is absorbed.
        light: a unit vector to the lamp, shape (3,).

    Returns:
        An image as `image`.
    """
    height, width = depth.shape
    corners = surface.corners
    if not len(corners):
        return image
    normals = vertex_normals(surface.points, corners) @ view.axes.T
    at = view.project(surface.points.astype(np.float64), (width, height))
    with wp.ScopedDevice("cpu"):
        mesh = [wp.array(corners, dtype=wp.vec3i), wp.array(at, dtype=wp.vec3), wp.array(normals, dtype=wp.vec3)]
        lens = _lens(view, width, height, light)
        water = kernels.Water()
        water.absorption, water.deep, water.haze = wp.vec3(*(ABSORPTION / size)), wp.vec3(*DEEP), wp.vec3(*HAZE)
        opaque = wp.array(np.minimum(depth, FAR).astype(np.float32), dtype=wp.float32)
        layers = _layers(mesh, opaque, 1e-4 * size)
        shown = wp.array(np.square(image * np.float32(1.0 / 255.0)), dtype=wp.vec3)  # a gamma of 2 is near enough
        other = wp.empty_like(shown)
        for front, normal, back in reversed(layers):
            wp.launch(kernels.shade_kernel, depth.shape, [lens, water, front, normal, back, opaque, shown, other])
            shown, other = other, shown
        return (np.float32(255.0) * np.sqrt(np.clip(shown.numpy(), 0.0, 1.0)) + np.float32(0.5)).astype(np.uint8)


def vertex_normals(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return outward unit normals at the points of a surface, shape (n, 3): means over the triangles by their areas, smoothed."""
    a, b, c = (points[corners[:, k]].astype(np.float64) for k in range(3))
    of_triangle = np.cross(b - a, c - a)
    normals = _summed(of_triangle, corners, len(points))
    for _ in range(SMOOTHINGS):
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        normals = _summed(normals[corners].sum(axis=1), corners, len(points))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _summed(of_triangle: np.ndarray, corners: np.ndarray, count: int) -> np.ndarray:
    """Return for each point the sum over its triangles."""
    weights = np.repeat(of_triangle, 3, axis=0)
    return np.stack([np.bincount(corners.ravel(), weights[:, k], count) for k in range(3)], axis=-1)


def _layers(mesh: list[wp.array], opaque: wp.array, slack: float) -> list[tuple[wp.array, wp.array, wp.array]]:
    """Return depth and normal where a line of sight enters the water, and the depth where it leaves, the nearest layer first."""
    layers: list[tuple[wp.array, wp.array, wp.array]] = []
    beyond = wp.zeros_like(opaque)
    for _ in range(LAYERS):
        front, back = wp.full_like(opaque, FAR), wp.full_like(opaque, FAR)
        normal, unused = wp.zeros(opaque.shape, dtype=wp.vec3), wp.zeros(opaque.shape, dtype=wp.vec3)
        wp.launch(kernels.rasterize_kernel, len(mesh[0]), [*mesh, 1.0, beyond, slack, front, normal])
        if layers and float(front.numpy().min()) >= FAR:
            break
        wp.launch(kernels.rasterize_kernel, len(mesh[0]), [*mesh, -1.0, front, 0.0, back, unused])
        layers.append((front, normal, back))
        beyond = back
    return layers


def _lens(view: Viewpoint, width: int, height: int, light: np.ndarray) -> kernels.Lens:
    lens = kernels.Lens()
    lens.width, lens.height, lens.focal = float(width), float(height), 0.5 * height / view.slope
    lens.up, lens.light = wp.vec3(*view.axes[:, 1]), wp.vec3(*(view.axes @ light))
    return lens
