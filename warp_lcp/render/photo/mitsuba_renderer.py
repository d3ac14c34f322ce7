"""Path tracing of a `PhotoScene` by Mitsuba 3, with a denoiser.

The denoiser is Open Image Denoise. Needs the extra `photo`.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import cache
from glob import glob
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from warp_lcp.files import Tables
from warp_lcp.render.image_content import RenderError
from warp_lcp.render.photo.photo_scene import PhotoMesh, PhotoScene, SurfaceFinish
from warp_lcp.scene.camera import Viewpoint

if TYPE_CHECKING:
    import mitsuba

INSTALL = "pip install 'warp-lcp[photo]'"
# The first is compiled ahead of time; the second is twice as fast, compiled at run time by LLVM.
SCALAR, LLVM = "scalar_rgb", "llvm_ad_rgb"
OLDEST_LLVM = 16  # Dr.Jit 1.5 crashes with 14 and 15
LLVM_FOLDERS = [
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
]
LLVM_FILE = re.compile(r"libLLVM(?:-|\.so\.|\.)?(\d+)?.*")
TRIAL = """
import mitsuba
mitsuba.set_variant("llvm_ad_rgb")
scene = {"type": "scene", "integrator": {"type": "volpath"}}
scene |= {"sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
mitsuba.render(mitsuba.load_dict(scene), spp=1).numpy()
"""
VERSION = 1  # version of the pictures' appearance; pictures of another version are rendered again
DEPTH, ROULETTE = 20, 10  # most bounces; bounce from which paths end at random
SUBFRAMES = 8  # instants of a shutter interval, with motion
PASS_PATHS = 4_000_000  # most paths of a pass
# Limit of a pixel's mean radiance in a pass: rare bright paths would leave spots.
LARGEST_SAMPLE = 30.0
GROUND_REACH = 60.0  # size of the ground, relative to the domain
GROUND = [0.62, 0.61, 0.595]  # reflectance
SKY_ROWS = 256
WATER_INDEX, ROUGHNESS = 1.33, 0.35


@dataclass(frozen=True)
class Quality:
    """Quality of a picture.

    Args:
        size: width and height [pixels].
        samples: paths per pixel.
        shutter: duration of the exposure [s]; 0 for an instant.
    """

    size: tuple[int, int]
    samples: int
    shutter: float = 0.0


def load_renderer(variant: str = SCALAR) -> ModuleType:
    """Return the module `mitsuba`, ready to render.

    Args:
        variant: variant of Mitsuba; the one for LLVM needs `choose_variant` before.

    Raises:
        RenderError: Mitsuba or Open Image Denoise is not installed.
    """
    try:
        import mitsuba
        import PIL  # noqa: F401
        import pyoidn  # noqa: F401
    except (ImportError, OSError) as error:
        raise RenderError(
            f"--look photo needs the extra `photo`, which cannot be loaded ({error}): {INSTALL}"
        ) from error
    mitsuba.set_variant(variant)
    return mitsuba


@cache
def choose_variant() -> str:
    """Return the LLVM variant if it renders, else the scalar one.

    It is tried in another process, since some versions crash.
    """
    path = os.environ.get("DRJIT_LIBLLVM_PATH") or find_llvm()
    if path is None:
        return SCALAR
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": path}
    try:
        trial = subprocess.run(
            [sys.executable, "-c", TRIAL],
            env=environment,
            capture_output=True,
            timeout=120,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return SCALAR
    if trial.returncode:
        return SCALAR
    os.environ["DRJIT_LIBLLVM_PATH"] = path
    return LLVM


def find_llvm() -> str | None:
    """Return the file name of the newest LLVM library from `OLDEST_LLVM` on.

    None if there is none.
    """
    libraries = {}
    for folder in LLVM_FOLDERS:
        for file in glob(f"{folder}/libLLVM*"):
            version = LLVM_FILE.fullmatch(os.path.basename(file))
            if version and version[1] and int(version[1]) >= OLDEST_LLVM:
                libraries[int(version[1])] = file
    return libraries[max(libraries)] if libraries else None


def render_radiance(
    scene: PhotoScene, quality: Quality, seed: int, variant: str = SCALAR
) -> np.ndarray:
    """Return the denoised scene-linear radiance of a picture, (height, width, 3).

    Motion blur is the mean over instants of the shutter interval, each rendered with its share of
    the samples.

    Args:
        scene: content of the picture.
        quality: size, samples and shutter.
        seed: seed of the random numbers; equal seeds give equal pictures.
        variant: variant of Mitsuba; pictures of two variants differ in their noise.
    """
    mitsuba = load_renderer(variant)
    moves = quality.shutter > 0.0 and any(mesh.velocity is not None for mesh in scene.meshes)
    instants = min(SUBFRAMES, quality.samples) if moves else 1
    shares = pass_samples(quality, instants)
    total = np.zeros((quality.size[1], quality.size[0], 9))
    for instant in range(instants):
        shift = quality.shutter * ((instant + 0.5) / instants - 0.5)
        loaded = mitsuba.load_dict(scene_plugins(mitsuba, displaced(scene, shift), quality.size))
        for number, samples in enumerate(shares):
            layers = np.array(
                mitsuba.render(
                    loaded, spp=samples, seed=(seed * SUBFRAMES + instant) * len(shares) + number
                )
            )
            layers = np.nan_to_num(layers, posinf=LARGEST_SAMPLE)
            layers[..., :3] = np.clip(layers[..., :3], 0.0, LARGEST_SAMPLE)
            total += samples / (instants * sum(shares)) * layers
        del loaded
    return denoised(total)


def pass_samples(quality: Quality, instants: int) -> list[int]:
    """Return the samples of each pass of an instant.

    A pass has at most `PASS_PATHS` paths, which limits the memory.
    """
    each = max(1, round(quality.samples / instants))
    passes = min(each, math.ceil(each * math.prod(quality.size) / PASS_PATHS))
    return [each // passes + (number < each % passes) for number in range(passes)]


def denoised(layers: np.ndarray) -> np.ndarray:
    """Return denoised radiance, from layers of shape (height, width, 9).

    The layers are radiance, albedo and normal.
    """
    import pyoidn

    radiance, albedo, normal = (
        np.ascontiguousarray(layers[..., start : start + 3], dtype=np.float32)
        for start in (0, 3, 6)
    )
    return np.asarray(
        pyoidn.denoise(
            radiance, albedo=np.clip(albedo, 0.0, 1.0), normal=np.clip(normal, -1.0, 1.0), hdr=True
        )
    )


def displaced(scene: PhotoScene, time: float) -> PhotoScene:
    """Return a scene with all moving points displaced by their velocity over time [s]."""
    if not time:
        return scene
    meshes = [
        mesh if mesh.velocity is None else replace(mesh, points=mesh.points + time * mesh.velocity)
        for mesh in scene.meshes
    ]
    return replace(scene, meshes=meshes)


def scene_plugins(mitsuba: ModuleType, scene: PhotoScene, size: tuple[int, int]) -> Tables:
    """Return a scene as a dict for `mitsuba.load_dict`.

    With integrator, sensor, sky, ground and meshes.
    """
    transform = mitsuba.ScalarTransform4f
    reach = GROUND_REACH * float(scene.size.max())
    middle = 0.5 * scene.size
    absorbing = any(mesh.finish is SurfaceFinish.LIQUID for mesh in scene.meshes)
    path = {"type": "volpath" if absorbing else "path", "max_depth": DEPTH, "rr_depth": ROULETTE}
    lying = (
        transform()
        .translate([middle[0], scene.ground, middle[2]])
        .rotate([1, 0, 0], -90)
        .scale(reach)
    )
    plugins: Tables = {
        "type": "scene",
        "integrator": {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "image": path},
        "sensor": sensor_plugin(transform, scene.view, size),
        "sky": {"type": "envmap", "bitmap": mitsuba.Bitmap(sky())},
        "ground": {
            "type": "rectangle",
            "to_world": lying,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": GROUND}},
        },
    }
    for mesh in scene.meshes:
        plugins[mesh.name] = mesh_plugin(mitsuba, mesh)
    return plugins


def sensor_plugin(
    transform: type[mitsuba.ScalarTransform4f], view: Viewpoint, size: tuple[int, int]
) -> Tables:
    """Return the plugin of the camera."""
    return {
        "type": "perspective",
        "fov": view.angle,
        "fov_axis": "y",
        "near_clip": 1e-3 * float(np.linalg.norm(view.focus - view.position)),
        "far_clip": 1e4 * float(np.linalg.norm(view.focus - view.position)),
        "to_world": transform().look_at(
            view.position.tolist(), view.focus.tolist(), view.up.tolist()
        ),
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        },
        "sampler": {"type": "independent"},  # patterns of stratified samplers survive the denoiser
    }


def mesh_plugin(mitsuba: ModuleType, mesh: PhotoMesh) -> mitsuba.Mesh:
    """Return a mesh with its material; an absorbing one contains a medium."""
    properties = mitsuba.Properties()
    colored = mesh.color.ndim == 2
    properties["surface"] = mitsuba.load_dict(surface_plugin(mesh, colored))
    if mesh.finish is SurfaceFinish.LIQUID:
        # Colors of plugins are at most 1, `scale` is unlimited.
        most = max(float(mesh.color.max()), 1e-9)
        color = {"type": "rgb", "value": (mesh.color / most).tolist()}
        properties["interior"] = mitsuba.load_dict(
            {"type": "homogeneous", "albedo": 0.0, "scale": most, "sigma_t": color}
        )
    if mesh.normals is None:
        properties["face_normals"] = True
    plugin = mitsuba.Mesh(
        mesh.name,
        len(mesh.points),
        len(mesh.corners),
        props=properties,
        has_vertex_normals=mesh.normals is not None,
    )
    if colored:
        plugin.add_attribute(
            "vertex_color", 3, np.ascontiguousarray(mesh.color, dtype=np.float32).ravel()
        )
    data = mitsuba.traverse(plugin)
    data["vertex_positions"] = np.ascontiguousarray(mesh.points, dtype=np.float32).ravel()
    data["faces"] = np.ascontiguousarray(mesh.corners, dtype=np.uint32).ravel()
    if mesh.normals is not None:
        data["vertex_normals"] = np.ascontiguousarray(mesh.normals, dtype=np.float32).ravel()
    data.update()
    return plugin


def surface_plugin(mesh: PhotoMesh, colored: bool) -> Tables:
    """Return the scattering model of a surface."""
    if mesh.finish is SurfaceFinish.LIQUID:
        return {"type": "dielectric", "int_ior": WATER_INDEX, "ext_ior": 1.0}
    color = (
        {"type": "mesh_attribute", "name": "vertex_color"}
        if colored
        else {"type": "rgb", "value": np.asarray(mesh.color).tolist()}
    )
    if mesh.finish is SurfaceFinish.SATIN:
        return {
            "type": "twosided",
            "inner": {
                "type": "principled",
                "base_color": color,
                "roughness": ROUGHNESS,
                "specular": 0.5,
            },
        }
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": color}}


def sky() -> np.ndarray:
    """Return the radiance of a studio's sky by direction, shape (rows, 2 rows, 3).

    A gradient, a large key light, and a rim light; y is up.
    """
    polar = (np.arange(SKY_ROWS) + 0.5) / SKY_ROWS * math.pi
    around = (np.arange(2 * SKY_ROWS) + 0.5) / SKY_ROWS * math.pi
    polar, around = np.meshgrid(polar, around, indexing="ij")
    # Mitsuba's environment map: d = (sin phi sin theta, cos theta, -cos phi sin theta).
    direction = np.stack(
        [np.sin(around) * np.sin(polar), np.cos(polar), -np.cos(around) * np.sin(polar)], axis=-1
    )
    height = np.clip(direction[..., 1:2], 0.0, 1.0) ** 0.6
    radiance = (1.0 - height) * np.array([0.80, 0.84, 0.90]) + height * np.array([0.14, 0.24, 0.46])
    radiance = np.where(direction[..., 1:2] < 0.0, np.array([0.30, 0.30, 0.31]), radiance)
    # Key light, from the left.
    radiance += _lamp(direction, [-0.75, 1.0, -0.1], 13.0, 3.0, [28.0, 25.8, 22.5])
    # Rim light, from behind on the right.
    radiance += _lamp(direction, [1.0, 0.45, -0.9], 18.0, 8.0, [2.0, 2.3, 2.8])
    return radiance.astype(np.float32)


def _lamp(
    direction: np.ndarray, toward: list[float], radius: float, edge: float, color: list[float]
) -> np.ndarray:
    """Return the radiance of a round lamp with a soft edge [degrees]."""
    axis = np.array(toward) / np.linalg.norm(toward)
    angle = np.degrees(np.arccos(np.clip(direction @ axis, -1.0, 1.0)))
    return np.clip((radius - angle) / edge + 0.5, 0.0, 1.0)[..., None] * np.array(color)
