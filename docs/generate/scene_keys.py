"""Writes docs/scenes.md from the schemas of scene files: `python docs/generate/scene_keys.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from warp_lcp.scene.scene_file import installed_simulators

PAGE = Path(__file__).parents[1] / "scenes.md"
MATERIALS = {"fluids": "liquid", "granular": "sand", "contacts": "bodies alone"}
SHAPES = ("box", "sphere", "capsule", "plane", "mesh")
Definition = dict[str, Any]

HEAD = """# Scene files

<!-- Written by docs/generate/scene_keys.py from `warp-lcp schema`; do not edit. -->

A scene is a TOML file in SI units, with angles in degrees. y is up; a domain of two lengths is 2-D, the x-y plane. The
[tutorial](tutorial.md) writes some from nothing; [liquids](liquids.md), [sand](sand.md) and [rigid bodies](bodies.md) say what models do;
`warp-lcp check` says what is wrong with a scene; `warp-lcp schema` prints what this page says, for editors (of sand: `--simulator
granular`).

A key with a default may be left out. A key that no table has is refused, and the message names the nearest one. `--set table.key=value` on
the command line overrides a key.
"""

TIMES = """### When steps end

Steps end exactly at frames. They end, too, where a source or drain starts or stops or a solid's velocity jumps, unless that is closer than
a quarter of a step to the step's start or to a frame, or another such time follows within the step: the step then runs across it. What a
source lets in is exact all the same, the flow has its velocity in the steps in whose middle it runs, and a drain acts at the end of each
step in part of which it is open.
"""

PLACED = """Any shape may be moved from where its keys put it, in this order: `scale`, `rotate`, `translate`.

**`rotate` turns about the origin**, the low corner of the domain, and not about the shape's center, unless `about` names another point:
`about = [0.5, 0.2]` with `rotate = 30.0` turns a box around [0.5, 0.2] on the spot. So does `scale`. In 2-D `rotate` is one angle,
counterclockwise; in 3-D it is three, about the fixed axes x, then y, then z, each counterclockwise seen from the axis's tip."""

MOVING = """A moving solid has `motion = { kind = "...", ... }`, a function of time alone that starts from where the shape is placed. Angles
are in degrees; those of `keyframes` are about the axes and in the order of [`rotate`](#placing-a-shape), but through `center`.
"""

MESHES = """A mesh is a closed surface: what its triangles surround, counted by the winding number, is inside. `warp-lcp check` and the
start of a run say what was put right, with the file, how many triangles and where the first is:

- vertices closer than a millionth of the mesh's size become one; repeated triangles and those without area are dropped;
- triangles that disagree with their neighbors are turned, and so are parts that are inside out, but for the walls of hollows;
- triangles that cross others, and parts inside other parts, stay: what is surrounded twice is inside. Such a mesh is no rigid body, since
  what is there twice would weigh twice; and it is refused where more than 1 % of it is inside out, since that much would be missing.

Open surfaces, surfaces with one side only and surfaces without a volume are refused."""


def reference(prop: Definition) -> str | None:
    """Return the name of the definition that a property refers to, itself or as one of its alternatives."""
    for part in (prop, *prop.get("anyOf", ())):
        if "$ref" in part:
            return str(part["$ref"]).rsplit("/", 1)[1]
    return None


def toml(value: Any) -> str:
    """Return a default as a scene file has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if isinstance(value, float) and abs(value) < 1e6 else str(value)


def bounds(prop: Definition) -> str:
    """Return the range of a number in words of mathematics, empty where there is none."""
    low = f">= {prop['minimum']:g}" if "minimum" in prop else f"> {prop['exclusiveMinimum']:g}" if "exclusiveMinimum" in prop else ""
    high = f"<= {prop['maximum']:g}" if "maximum" in prop else f"< {prop['exclusiveMaximum']:g}" if "exclusiveMaximum" in prop else ""
    return ", ".join(part for part in (low, high) if part)


def values(prop: Definition) -> str:
    """Return what a key may hold."""
    if "anyOf" in prop:
        return " or ".join(values(part) for part in prop["anyOf"] if part.get("type") != "null")
    if "const" in prop:
        return f"`{toml(prop['const'])}`"
    if "enum" in prop:
        return ", ".join(f"`{toml(name)}`" for name in prop["enum"])
    if "discriminator" in prop:
        return "a [motion](#motions)"
    kind = prop.get("type")
    if kind == "array":
        least, most = prop.get("minItems", 0), prop.get("maxItems")
        count = "" if most is None else f"{least} " if least == most else f"{least} or {most} "
        inner = prop.get("items", {})
        return f"list of {count}{plural(inner)}"
    words = {"number": "number", "integer": "integer", "boolean": "`true`, `false`", "string": "text"}
    return " ".join(part for part in (words[str(kind)], bounds(prop)) if part)


def plural(inner: Definition) -> str:
    """Return what a list holds."""
    if inner.get("type") in ("number", "integer"):
        return " ".join(part for part in ("numbers", bounds(inner)) if part)
    if inner.get("type") == "array":
        return "vectors"
    return f"({values(inner)})" if inner else "values"


def row(name: str, prop: Definition, required: bool) -> str:
    """Return a key's line of a table."""
    said = prop.get("description", "")
    default = toml(prop["default"]) if prop.get("default") is not None else ""
    shown = f"`{default}`" if default else "required" if required and "unless given" not in said else "-"
    return f"| `{name}` | {said} | {values(prop)} | {shown} |"


def table(definition: Definition, leave_out: frozenset[str] = frozenset()) -> str:
    """Return the keys of a definition as a Markdown table, empty if it has none."""
    required = definition.get("required", ())
    rows = [
        row(name, prop, name in required)
        for name, prop in definition["properties"].items()
        if name not in leave_out and reference(prop) is None
    ]
    return "\n".join(["| key | meaning | values | default |", "|---|---|---|---|", *rows]) + "\n" if rows else ""


def said_of(definition: Definition) -> str:
    """Return a definition's sentence, without the name of its table."""
    text = definition["description"].split("]: ", 1)[-1]
    text = text.split("], ", 1)[-1] if text.startswith("[") else text
    return text[0].upper() + text[1:]


def section(level: int, name: str, definition: Definition) -> str:
    """Return the section of a table."""
    return f"{'#' * level} [{name}]\n\n{said_of(definition)}\n\n{table(definition)}"


def tables_of(schema: Definition) -> dict[str, Definition]:
    """Return a simulator's tables by name, tables within tables included."""
    found = {}
    for name, prop in schema["properties"].items():
        if (target := reference(prop)) is not None:
            found[name] = schema["$defs"][target]
            for inner, part in found[name]["properties"].items():
                if (deeper := reference(part)) is not None:
                    found[f"{name}.{inner}"] = schema["$defs"][deeper]
    return found


def shapes_of(schema: Definition, name: str) -> dict[str, Definition]:
    """Return the definitions of an array of shapes, by shape."""
    mapping = schema["properties"][name]["items"]["discriminator"]["mapping"]
    return {shape: schema["$defs"][mapping[shape].rsplit("/", 1)[1]] for shape in SHAPES}


def arrays_of(schema: Definition) -> list[str]:
    """Return the arrays of shapes of a simulator's scenes."""
    return [name for name, prop in schema["properties"].items() if "discriminator" in prop.get("items", {})]


def lists_of(schema: Definition) -> dict[str, Definition]:
    """Return the arrays of tables of a simulator's scenes, but for shapes, by name."""
    entries = {name: reference(prop.get("items", {})) for name, prop in schema["properties"].items()}
    return {name: schema["$defs"][target] for name, target in entries.items() if target is not None}


def shape_section(schema: Definition) -> str:
    """Return what says where a shape lies, whatever it is made of."""
    drains = shapes_of(schema, "drain")
    common = {key for key in drains["box"]["properties"] if all(key in other["properties"] for other in drains.values())}
    timed = frozenset({"start", "stop", "shape"})
    own = []
    for shape, definition in drains.items():
        kept = frozenset(common | timed)
        own.append(f'### shape = "{shape}"\n\n{table(definition, kept)}' + (f"\n{MESHES}\n" if shape == "mesh" else ""))
    everywhere = {**drains["box"], "properties": {key: prop for key, prop in drains["box"]["properties"].items() if key in common - timed}}
    return "\n".join(
        ["## Shapes\n", "A `[[liquid]]`, `[[sand]]`, `[[solid]]`, `[[source]]` or `[[drain]]` is a shape: `shape` and its keys.\n", *own]
    ) + (f"\n### Placing a shape\n\n{PLACED}\n\n{table(everywhere)}")


def motion_section(schema: Definition) -> str:
    """Return the kinds of motion."""
    parts = ["## Motions\n", MOVING]
    for name, definition in schema["$defs"].items():
        if name.endswith("Motion"):
            kind = definition["properties"]["kind"]["const"]
            parts.append(f'### kind = "{kind}"\n\n{said_of(definition)}\n\n{table(definition, frozenset({"kind"}))}')
    return "\n".join(parts)


BODIES = """## Rigid bodies

A `[[solid]]` with `mass` or `density` is a rigid body: gravity, the material and other bodies move it. Its shape is filled evenly; 2-D
masses are those of a meter of depth, and a mesh is its cut by z = 0. It starts where its shape is placed, apart from the domain's walls
and other solids.

Bodies touch the domain's walls, where it has some, solids that stand or have a `motion`, and each other. Coulomb's coefficient is the
body's `friction`; of two bodies it is the geometric mean, and the greater `restitution` counts. They cannot cross the sides of periodic
axes.

The log has the place, velocity and turn of each body, numbered from 0 in the order of the solids: `body0_x`, `body0_vx`, in 2-D
`body0_angle` and `body0_spin` (degrees, degrees/s), in 3-D `body0_wx` and so on (degrees/s). Frames have their surfaces, `bodies.pvd`.
"""


BODIES_ALONE = """`scene.simulator = "contacts"`. Walls, gravity and [[solid]]s, at least one with `density` or `mass`, as in a liquid; see
[bodies without a material](bodies.md#without-a-material).
"""


def array_section(schema: Definition, name: str) -> str:
    """Return the keys of an array besides those of its shape."""
    definition = shapes_of(schema, name)["box"]
    of_shape = frozenset(shapes_of(schema, "drain")["box"]["properties"]) - {"start", "stop"}
    rows = table(definition, of_shape)
    return f"### [[{name}]]\n\nA [shape](#shapes), and:\n\n{rows}" if rows else f"### [[{name}]]\n\nA [shape](#shapes).\n"


def page() -> str:
    """Return the page."""
    installed = installed_simulators()
    schemas = {name: installed[name].scene_model.model_json_schema(by_alias=True) for name in MATERIALS}
    first, second, _ = schemas.values()
    tables = {name: tables_of(schema) for name, schema in schemas.items()}
    shared = [name for name, definition in tables["fluids"].items() if tables["granular"].get(name) == definition]
    parts = [HEAD, "## Every scene\n", *(section(3, name, tables["fluids"][name]) for name in shared)]
    alike = [name for name in arrays_of(first) if name in arrays_of(second) and shapes_of(first, name) == shapes_of(second, name)]
    parts += [array_section(first, name) for name in alike]
    parts += [TIMES, shape_section(first), motion_section(first), BODIES]
    for simulator, material in MATERIALS.items():
        schema = schemas[simulator]
        if simulator == "contacts":  # the same [[solid]] as in liquids, and some of the tables
            own = {name: definition for name, definition in tables[simulator].items() if tables["fluids"].get(name) != definition}
            parts.append(f"## {material.capitalize()}\n\n{BODIES_ALONE}")
            parts += [section(3, name, definition) for name, definition in own.items()]
            parts += [section(3, f"[{name}]", definition) for name, definition in lists_of(schema).items()]
            continue
        parts.append(f'## {material.capitalize()}\n\n`scene.simulator = "{simulator}"`.\n')
        parts += [section(3, name, definition) for name, definition in tables[simulator].items() if name not in shared]
        parts += [section(3, f"[{name}]", definition) for name, definition in lists_of(schema).items()]
        parts += [array_section(schema, name) for name in arrays_of(schema) if name not in alike]
    return "\n".join(parts).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
