# mypy: ignore-errors
"""Kernels that draw a surface of water over an image, on the CPU: Warp runs the threads of a launch in order there, so that none races.

Buffers have the shape of the image, row 0 at its top. Depths are along the line of sight [m]; FAR where there is nothing.
"""

import warp as wp

FAR = wp.constant(wp.float32(1.0e30))
RATIO = wp.constant(1.0 / 1.333)  # of the refractive indices of air and water
AT_NORMAL = wp.constant(0.04)  # the share of light that is mirrored at normal incidence: twice that of water, to show its shape


@wp.struct
class Lens:
    """A pinhole camera as the kernels need it; directions and points are in its axes: right, up, into the scene."""

    width: wp.float32  # of the image [pixels]
    height: wp.float32
    focal: wp.float32  # pixels a unit of slope
    up: wp.vec3  # y of the scene
    light: wp.vec3  # to the lamp


@wp.struct
class Water:
    """What water does to light, colors linear from 0 to 1."""

    absorption: wp.vec3  # of red, green and blue [1/m]
    deep: wp.vec3  # the color of water without end
    haze: wp.vec3  # what is seen where a ray is bent away from the white behind the scene


@wp.func
def edge(a: wp.vec3, b: wp.vec3, x: wp.float32, y: wp.float32):
    """Return twice the area of a triangle a, b, (x, y) in the image."""
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


@wp.kernel
def rasterize_kernel(
    corners: wp.array(dtype=wp.vec3i),
    at: wp.array(dtype=wp.vec3),  # x, y [pixels] and depth [m] of each point
    normals: wp.array(dtype=wp.vec3),
    sign: wp.float32,  # 1: triangles that face the camera, -1: those that face away
    beyond: wp.array2d(dtype=wp.float32),  # only what lies deeper counts
    slack: wp.float32,
    depth: wp.array2d(dtype=wp.float32),  # of the nearest (written)
    normal: wp.array2d(dtype=wp.vec3),  # there (written)
):
    """Find the nearest triangle in every pixel."""
    corner = corners[wp.tid()]
    a, b, c = at[corner[0]], at[corner[1]], at[corner[2]]
    area = edge(a, b, c[0], c[1])  # y points down: triangles that face the camera have a negative one
    if wp.min(a[2], wp.min(b[2], c[2])) <= 0.0 or area * sign >= 0.0:
        return
    left = wp.max(int(wp.ceil(wp.min(a[0], wp.min(b[0], c[0])) - 0.5)), 0)
    right = wp.min(int(wp.floor(wp.max(a[0], wp.max(b[0], c[0])) - 0.5)), depth.shape[1] - 1)
    top = wp.max(int(wp.ceil(wp.min(a[1], wp.min(b[1], c[1])) - 0.5)), 0)
    bottom = wp.min(int(wp.floor(wp.max(a[1], wp.max(b[1], c[1])) - 0.5)), depth.shape[0] - 1)
    for i in range(top, bottom + 1):
        y = float(i) + 0.5
        for j in range(left, right + 1):
            x = float(j) + 0.5
            u = edge(b, c, x, y) / area
            v = edge(c, a, x, y) / area
            w = 1.0 - u - v
            if wp.min(u, wp.min(v, w)) >= 0.0:
                z = 1.0 / (u / a[2] + v / b[2] + w / c[2])
                if z > beyond[i, j] + slack:
                    if z < depth[i, j]:
                        depth[i, j] = z
                        normal[i, j] = u * normals[corner[0]] + v * normals[corner[1]] + w * normals[corner[2]]


@wp.func
def sky(up: wp.float32):
    """Return the light from a direction of which `up` is the vertical component: a bright ceiling, a pale horizon and a gray floor."""
    high = wp.smoothstep(0.15, 0.8, up)
    low = wp.smoothstep(0.0, 0.35, -up)
    color = wp.lerp(wp.vec3(0.50, 0.66, 0.80), wp.vec3(1.25, 1.25, 1.25), high)
    return wp.lerp(color, wp.vec3(0.16, 0.22, 0.28), low)


@wp.kernel
def shade_kernel(
    lens: Lens,
    water: Water,
    front: wp.array2d(dtype=wp.float32),
    normal: wp.array2d(dtype=wp.vec3),
    back: wp.array2d(dtype=wp.float32),
    opaque: wp.array2d(dtype=wp.float32),  # depth of what water does not let through
    behind: wp.array2d(dtype=wp.vec3),  # the image without this layer
    image: wp.array2d(dtype=wp.vec3),  # with it (written)
):
    """Lay the nearest water over the image: what is behind it, bent and dimmed, the color of its depth, and what it mirrors."""
    i, j = wp.tid()
    near = front[i, j]
    if near >= FAR or near >= opaque[i, j]:
        image[i, j] = behind[i, j]
        return
    through = wp.normalize(
        wp.vec3((float(j) + 0.5 - 0.5 * lens.width) / lens.focal, (0.5 * lens.height - float(i) - 0.5) / lens.focal, 1.0)
    )
    outward = wp.normalize(normal[i, j])
    facing = -wp.dot(outward, through)
    if facing < 0.03:  # the mean of the corners' normals may point away where the triangle does not
        outward = wp.normalize(outward - (facing - 0.03) * through)
        facing = 0.03
    thickness = (wp.min(back[i, j], opaque[i, j]) - near) / through[2]

    # Snell's law; what is seen is where the bent ray has come as far as the straight one
    root = wp.sqrt(1.0 - RATIO * RATIO * (1.0 - facing * facing))
    bent = RATIO * through + (RATIO * facing - root) * outward
    point = through * (near / through[2]) + bent * wp.min(thickness, 0.5 * near)
    column = int(0.5 * lens.width + lens.focal * point[0] / point[2])
    row = int(0.5 * lens.height - lens.focal * point[1] / point[2])
    if row < 0 or row >= image.shape[0] or column < 0 or column >= image.shape[1]:
        row, column = i, j
    if opaque[row, column] < near:  # that lies in front of the water
        row, column = i, j
    seen = behind[row, column]
    if opaque[row, column] >= FAR:
        seen = wp.lerp(seen, water.haze, wp.smoothstep(0.0, 0.35, 1.0 - wp.dot(bent, through)) * 0.9)

    upward = wp.dot(outward, lens.up)
    lit = 0.55 + 0.25 * upward + 0.55 * wp.max(wp.dot(outward, lens.light), 0.0)
    let_through = wp.vec3(
        wp.exp(-water.absorption[0] * thickness), wp.exp(-water.absorption[1] * thickness), wp.exp(-water.absorption[2] * thickness)
    )
    body = wp.cw_mul(seen, let_through) + wp.cw_mul(water.deep * lit, wp.vec3(1.0, 1.0, 1.0) - let_through)

    mirrored = through + 2.0 * facing * outward
    share = AT_NORMAL + (1.0 - AT_NORMAL) * wp.pow(1.0 - facing, 4.0)
    glint = wp.pow(wp.max(wp.dot(mirrored, lens.light), 0.0), 160.0)
    image[i, j] = wp.lerp(body, sky(wp.dot(mirrored, lens.up)), wp.min(share, 0.85)) + wp.vec3(1.0, 1.0, 1.0) * glint * 1.2
