r"""Render a run with Blender's Cycles, from a file of `warp-lcp export` or an OpenVDB frame.

    # Blender as a module, 5.0.1 for Python 3.11; in an environment of its own
    pip install bpy "numpy<2"
    warp-lcp export out/dam-break --out dam.usdc  # or dam.abc
    python docs/blender_render.py dam.usdc dam.png --frame 12 --position 2.4 1.6 2.8 \
        --look-at 0.8 0.15 0.4
    python docs/blender_render.py out/dam-break/frames/volume_000012.vdb fog.png \
        --position 2.4 1.6 2.8 --look-at 0.8 0.15 0.4

Positions are those of the scene [m], y up.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import bpy
import mathutils

# of water, 1/m for red, green and blue; the real one is hardly visible in a tank
ABSORPTION = (1.6, 0.47, 0.26)
# of water: shadow rays go straight on, so that what lies below it needs no caustics
SHADOW = (0.82, 0.92, 0.95, 1.0)
FLOOR, BODIES = (0.6, 0.6, 0.6), [(0.75, 0.24, 0.06), (0.85, 0.62, 0.08), (0.10, 0.35, 0.12)]
PARTICLES = (0.06, 0.25, 0.55)
GLASS_BOUNCES = 16
FOG_DENSITY = 60.0  # of the volume where the relative density is 1, 1/m
FAST = 2.5  # speed that is white [m/s]


def z_up(point: tuple[float, float, float]) -> mathutils.Vector:
    """Return Blender's coordinates of a scene's point."""
    x, y, z = point
    return mathutils.Vector((x, -z, y))


def water() -> Any:
    """Return a material: refraction, absorption by depth, and colored light below."""
    material = bpy.data.materials.new("water")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    glass = tree.nodes.new("ShaderNodeBsdfGlass")
    glass.inputs["IOR"].default_value, glass.inputs["Roughness"].default_value = 1.33, 0.0
    straight = tree.nodes.new("ShaderNodeBsdfTransparent")
    straight.inputs["Color"].default_value = SHADOW
    path, mix = tree.nodes.new("ShaderNodeLightPath"), tree.nodes.new("ShaderNodeMixShader")
    absorption, output = (
        tree.nodes.new("ShaderNodeVolumeAbsorption"),
        tree.nodes.new("ShaderNodeOutputMaterial"),
    )
    most = max(ABSORPTION)  # Cycles absorbs density * (1 - color)
    absorption.inputs["Density"].default_value = most
    absorption.inputs["Color"].default_value = (*(1.0 - value / most for value in ABSORPTION), 1.0)
    tree.links.new(path.outputs["Is Shadow Ray"], mix.inputs[0])
    tree.links.new(glass.outputs[0], mix.inputs[1])
    tree.links.new(straight.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    tree.links.new(absorption.outputs[0], output.inputs["Volume"])
    return material


def fog() -> Any:
    """Return a material of the grids `density` and `velocity`: fast liquid is white."""
    material = bpy.data.materials.new("fog")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    volume, output = (
        tree.nodes.new("ShaderNodeVolumePrincipled"),
        tree.nodes.new("ShaderNodeOutputMaterial"),
    )
    density, velocity = (tree.nodes.new("ShaderNodeAttribute") for _ in range(2))
    density.attribute_name, velocity.attribute_name = "density", "velocity"
    thick, speed, colors = (
        tree.nodes.new("ShaderNodeMath"),
        tree.nodes.new("ShaderNodeVectorMath"),
        tree.nodes.new("ShaderNodeValToRGB"),
    )
    share = tree.nodes.new("ShaderNodeMath")
    thick.operation, share.operation, speed.operation = "MULTIPLY", "DIVIDE", "LENGTH"
    thick.inputs[1].default_value, share.inputs[1].default_value = FOG_DENSITY, FAST
    colors.color_ramp.elements[0].color = (0.03, 0.16, 0.45, 1.0)
    colors.color_ramp.elements[1].color = (0.9, 0.95, 1.0, 1.0)
    volume.inputs["Density Attribute"].default_value = ""
    tree.links.new(density.outputs["Fac"], thick.inputs[0])
    tree.links.new(thick.outputs[0], volume.inputs["Density"])
    tree.links.new(velocity.outputs["Vector"], speed.inputs[0])
    tree.links.new(speed.outputs["Value"], share.inputs[0])
    tree.links.new(share.outputs[0], colors.inputs[0])
    tree.links.new(colors.outputs[0], volume.inputs["Color"])
    tree.links.new(volume.outputs[0], output.inputs["Volume"])
    return material


def load(scene: Any, options: argparse.Namespace) -> None:
    """Import the file, with materials, and go to the frame."""
    file, kind = str(options.file.resolve()), options.file.suffix.lower()
    if kind == ".vdb":
        bpy.ops.object.volume_import(filepath=file, files=[{"name": options.file.name}])
        volume = bpy.context.object
        volume.rotation_euler, volume.location = (math.radians(90.0), 0.0, 0.0), (0.0, 0.0, 0.0)
        volume.data.materials.append(fog())
        return
    if kind == ".abc":
        bpy.ops.wm.alembic_import(filepath=file, as_background_job=False)
    else:
        bpy.ops.wm.usd_import(filepath=file)
    scene.frame_set(options.frame)
    for item in (item for item in scene.objects if item.type == "POINTCLOUD"):
        item.data.materials.append(matte("particles", PARTICLES))
    for number, item in enumerate(item for item in scene.objects if item.type == "MESH"):
        item.data.materials.clear()
        color = BODIES[number % len(BODIES)]
        item.data.materials.append(
            water() if item.name.startswith("surface") else matte(item.name, color)
        )


def matte(name: str, color: tuple[float, float, float]) -> Any:
    """Return an opaque material of a linear color."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*color, 1.0)
    return material


def studio(scene: Any, size: float) -> None:
    """Add a floor, a sky and a soft key light."""
    # below the surface's own floor
    bpy.ops.mesh.primitive_plane_add(size=60.0 * size, location=(0.0, 0.0, -1e-3 * size))
    bpy.context.object.data.materials.append(matte("floor", FLOOR))
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (
        0.55,
        0.65,
        0.80,
        1.0,
    )
    light = bpy.data.lights.new("key", "SUN")
    light.energy, light.angle = 2.0, math.radians(15.0)
    key = bpy.data.objects.new("key", light)
    key.rotation_euler = mathutils.Vector((0.6, 0.1, -1.0)).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(key)


def camera(scene: Any, options: argparse.Namespace) -> None:
    """Look from one point at another."""
    made = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    made.location = z_up(options.position)
    made.rotation_euler = (
        (z_up(options.look_at) - made.location).to_track_quat("-Z", "Y").to_euler()
    )
    made.data.angle = math.radians(options.field_of_view)
    scene.collection.objects.link(made)
    scene.camera = made


def settings(scene: Any, options: argparse.Namespace) -> None:
    """Choose Cycles, its denoiser, AgX and motion blur."""
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.denoiser = (
        options.samples,
        True,
        "OPENIMAGEDENOISE",
    )
    scene.cycles.max_bounces = scene.cycles.transmission_bounces = GLASS_BOUNCES
    scene.cycles.sample_clamp_indirect = 10.0
    scene.render.resolution_x, scene.render.resolution_y = options.size
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 0.25
    scene.view_settings.view_transform, scene.view_settings.look = (
        "AgX",
        "AgX - Medium High Contrast",
    )
    scene.render.image_settings.file_format = "PNG"


def main() -> None:
    """Load, light and render one frame."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--position", type=float, nargs=3, required=True)
    parser.add_argument("--look-at", type=float, nargs=3, required=True)
    parser.add_argument("--field-of-view", type=float, default=36.0, help="horizontal [degrees]")
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--size", type=int, nargs=2, default=(960, 540))
    options = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    load(scene, options)
    studio(scene, max(max(item.dimensions) for item in scene.objects))
    camera(scene, options)
    settings(scene, options)
    scene.render.filepath = str(options.picture.resolve())
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
