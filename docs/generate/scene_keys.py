"""Write docs/scenes.md from the schemas of scene files.

Run `python docs/generate/scene_keys.py`.
"""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

from warp_lcp.granular.materials import MATERIALS
from warp_lcp.scene.scene_file import installed_simulators

PAGE = Path(__file__).parents[1] / "scenes.md"
SHAPES = ("box", "sphere", "capsule", "plane", "mesh")
SHARED = ("scene", "time", "domain", "physics", "output", "camera")
SAMPLED = ("particles", "particles.reseed", "particles.narrow_band", "density_correction")
# Keys whose headings explain them.
SELF_EVIDENT = (
    "scene",
    "time",
    "physics",
    "output",
    "particles",
    "solver",
    "pressure",
    "material",
    "friction",
)
ELSEWHERE = "unused with bodies alone"  # begins the description of a key that bodies alone inherit
LONG_LISTS = {  # words that replace a list of allowed values, by the key's default
    "vtu": "[formats](frames-and-films.md#other-formats)",
    "projected-multigrid": "others: those with * in [methods](methods.md)",
    "sweeps-and-newton": "[methods](bodies.md#without-a-material)",
}
Definition = dict[str, Any]

HEAD = """# Scene files

<!-- Written by docs/generate/scene_keys.py from `warp-lcp schema`; do not edit. -->

A scene is a TOML file, such as this `column.toml`:

```toml
[scene]
simulator = "fluids"     # or "granular", "contacts"

[time]
duration = 2.0

[domain]
size = [2.0, 1.0]        # two sides: the x-y plane
resolution = 64

[[liquid]]
shape = "box"
min = [0.0, 0.0]
max = [0.5, 0.8]
```

```sh
warp-lcp check column.toml                     # errors, suspicious settings
warp-lcp run column.toml --set time.cfl=1.0    # overrides a key
warp-lcp schema                                # JSON, for editors
```

Units are SI, angles are in degrees, y is up. Vectors have an entry per axis. Keys are optional
unless marked *required*. Unknown keys are refused; the message names the nearest key.
"""

STEPS = """Steps end exactly at frames. They also end when a source or drain starts or stops, or a
solid's velocity jumps, if that leaves at least a quarter of the step.
"""

DOMAIN = """Material may leave `separating` walls. It slides along `free-slip` walls and sticks to
`sticky` ones, which need `[viscosity]`.
"""

MATERIAL = """## Material, sources and drains

`[[liquid]]` and `[[sand]]` fill their [shape](#shapes) at the start. A `[[source]]` lets material
in, a `[[drain]]` removes it.

The particles of a source lie on a lattice without layers across the flow, so that a falling sheet
is stretched evenly. With two particles along a cell's edge its surface has holes where the sheet
is thinner than about 0.6 cells; use a thicker source or a finer grid.
"""

PLACED = """### Placing a shape

A shape is moved by `scale`, `rotate` and `translate`, in this order. **`rotate` and `scale` are
about the origin**, not about the shape's center; `about` gives another point. 2-D angles are
counterclockwise; in 3-D a shape is rotated about the fixed axes x, then y, then z.
"""

SHAPED = """## Shapes

A shape has a `shape` and its keys, all of them required but `thickness`:
"""

MESHES = """A mesh is a closed surface, in 2-D its cut by z = 0. Inside, its winding number is
positive. Vertices closer than a millionth of its size are merged, triangles without area are
dropped, and triangles and parts that are inside out are flipped; `warp-lcp check` and `run` report
this. Intersecting and nested parts stay, but such a mesh cannot be a rigid body. One-sided surfaces
are refused, and those of which more than 1 % stays inside out. An open mesh is refused, unless
`thickness` is given: then it is the middle of a wall, which may be
[thinner than a cell](liquids.md#walls-thinner-than-cells).
"""

MOVING = """## Motions

`motion = { kind = "...", ... }` moves a solid from where its shape is placed. Angles of `keyframes`
are in the order of [`rotate`](#placing-a-shape), about axes through `center`.
"""

BODIES = """## Rigid bodies

A `[[solid]]` with `mass` or `density` is a [rigid body](bodies.md). It must start apart from walls
and other solids. A 2-D mass is that of a meter of depth.
"""

LIQUID = """## Liquid

`scene.simulator = "fluids"`. See [liquids](liquids.md).
"""

SAND = """## Sand

`scene.simulator = "granular"`. See [sand](sand.md). `solver.preset` is that of liquids.
"""

CONTACTS = """## Bodies alone

`scene.simulator = "contacts"`: walls, gravity and `[[solid]]`s, at least one of them a rigid body.
See [bodies without a material](bodies.md#without-a-material). There are no presets and no frames of
material.
"""

LIMITS = """## Limits

- At most 8192 cells along an axis. Sides must be whole numbers of cells.
- A scene has one kind of sand, and its walls are `separating`. Liquids may differ in viscosity, not
  in density.
- `narrow_band` and `output.forces` are for liquids only.
- Periodic axes are for sand without rigid bodies, sources, drains and reseeding; on ranks also
  without density correction (`density_correction.every = 0`).
- A solid is moved by `motion` or is a rigid body, not both. Neither works with `solids = "voxel"`.
"""


def reference(prop: Definition) -> str | None:
    """Return the name of the definition that a property refers to.

    The reference is that of the property itself, or of one of its alternatives.
    """
    for part in (prop, *prop.get("anyOf", ())):
        if "$ref" in part:
            return str(part["$ref"]).rsplit("/", 1)[1]
    return None


def toml(value: Any) -> str:
    """Return a default in the form of a scene file."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return f"{value:g}" if isinstance(value, float) and abs(value) < 1e6 else str(value)


def words(prop: Definition) -> list[str]:
    """Return the words that a key or the entries of its list may hold."""
    parts = [prop, *prop.get("anyOf", ()), prop.get("items", {})]
    return [word for part in parts for word in part.get("enum", ()) if isinstance(word, str)]


def bounds(prop: Definition) -> str:
    """Return the range of a number, unless it is only a sign or a share."""
    for part in (prop, *prop.get("anyOf", ())):
        if "minimum" in part and "maximum" in part:
            return f"{part['minimum']:g} to {part['maximum']:g}"
        if part.get("minimum", 0) > 1:
            return f">= {part['minimum']:g}"
    return ""


def default_of(name: str, prop: Definition, required: bool) -> str:
    """Return the table cell of a key's default."""
    default = prop.get("description", "").partition("; default: ")[2]
    if prop.get("default") not in (None, ""):
        return f"`{toml(prop['default'])}`"
    if default == "by name":
        first, *rest = MATERIALS
        return "; ".join(
            [
                f"`{getattr(MATERIALS[first], name):g}`",
                *(f"{other} `{getattr(MATERIALS[other], name):g}`" for other in rest),
            ]
        )
    return (
        f"`{default}`"
        if re.fullmatch(r"[a-z_]+\.[a-z_]+|\d+", default)
        else default or "required" * required
    )


def beyond(text: str, base: str) -> str:
    """Return a text without the initial words that it shares with `base`."""
    own, other = text.split(), base.split()
    alike = itertools.takewhile(
        lambda pair: pair[0].strip(";") == pair[1].strip(";"), zip(own, other, strict=False)
    )
    same = len(list(alike))
    return " ".join(own[same:])


def described(prop: Definition) -> str:
    """Return a key's description without its default."""
    return str(prop["description"]).partition("; default: ")[0]


def meaning_of(prop: Definition) -> str:
    """Return the meaning of a key and its allowed words."""
    meaning, allowed = described(prop), words(prop)
    if len(allowed) > 6:
        return f"{meaning}; {LONG_LISTS[prop['default']]}"
    if any(word not in meaning for word in allowed) and not meaning.endswith(" only"):
        return f"{meaning}: " + ", ".join(f"`{word}`" for word in allowed)
    return ", ".join(part for part in (meaning, bounds(prop)) if part)


def row(
    name: str, prop: Definition, required: bool, others: dict[str, Definition] | None = None
) -> str:
    """Return a key's row of a table.

    Args:
        name: name of the key.
        prop: property of the schema.
        required: whether the key is required.
        others: the key's properties in scenes of other materials, by their names.
    """
    meaning, default = meaning_of(prop), default_of(name, prop, required)
    for material, other in (others or {}).items():
        if not other["description"].startswith(ELSEWHERE):
            own, value = (
                beyond(described(other), described(prop)),
                default_of(name, other, required),
            )
            meaning += f"; {material}: {own}" if own else ""
            default += (
                f"{', ' * bool(default)}{material} {value}" if value and value != default else ""
            )
    return f"| `{name}` | {meaning} | {default} |"


def table(
    definition: Definition,
    leave_out: frozenset[str] = frozenset(),
    others: dict[str, Definition] | None = None,
) -> str:
    """Return the keys of a definition as a Markdown table, empty if it has none.

    Args:
        definition: definition of the schema.
        leave_out: keys that are in other tables.
        others: the same table in scenes of other materials, by their names.
    """
    required, rows = definition.get("required", ()), []
    properties = {material: other["properties"] for material, other in (others or {}).items()}
    for name, prop in definition["properties"].items():
        if (
            name not in leave_out
            and reference(prop) is None
            and not prop["description"].startswith(ELSEWHERE)
        ):
            differing = {
                material: keys[name] for material, keys in properties.items() if keys[name] != prop
            }
            rows.append(row(name, prop, name in required, differing))
    for material, keys in properties.items():
        own = {name: prop for name, prop in keys.items() if name not in definition["properties"]}
        rows += [
            row(name, {**prop, "description": f"{material}: {prop['description']}"}, False)
            for name, prop in own.items()
        ]
    return "\n".join(["| key | meaning | default |", "|---|---|---|", *rows]) + "\n" if rows else ""


def variant_table(
    kinds: dict[str, Definition], column: str, leave_out: frozenset[str], *, defaults: bool = True
) -> str:
    """Return the keys of tables of several kinds as one Markdown table.

    Args:
        kinds: definitions by kind.
        column: heading of the column of kinds.
        leave_out: keys that are in other tables.
        defaults: whether there is a column of defaults.
    """
    rows: dict[tuple[str, str, str], list[str]] = {}
    for kind, definition in kinds.items():
        for name, prop in definition["properties"].items():
            if name not in leave_out:
                cells = (
                    name,
                    meaning_of(prop),
                    default_of(name, prop, name in definition.get("required", ())),
                )
                rows.setdefault(cells, []).append(kind)
    last = [f" {default} |" * defaults for _, _, default in rows]
    lines = [
        f"| `{name}` | {', '.join(of)} | {meaning} |" for (name, meaning, _), of in rows.items()
    ]
    head = [
        f"| key | {column} | meaning |" + " default |" * defaults,
        "|---|---|---|" + "---|" * defaults,
    ]
    return "\n".join([*head, *(line + cell for line, cell in zip(lines, last, strict=True))]) + "\n"


def summary(definition: Definition) -> str:
    """Return a definition's description, without the name of its table."""
    text = definition["description"].split("]: ", 1)[-1]
    return text[0].upper() + text[1:]


def section(name: str, definition: Definition, others: dict[str, Definition] | None = None) -> str:
    """Return the section of a table, see `table`."""
    text = summary(definition)
    told = text.partition("\n\n")[2] if name in SELF_EVIDENT else text
    told += "\n\n" if told else ""
    return f"### [{name}]\n\n{told}{table(definition, others=others)}"


def tables_of(schema: Definition) -> dict[str, Definition]:
    """Return a simulator's tables by name, including nested tables."""
    tables = {}
    for name, prop in schema["properties"].items():
        if (target := reference(prop)) is not None:
            tables[name] = schema["$defs"][target]
            for inner, part in tables[name]["properties"].items():
                if (deeper := reference(part)) is not None:
                    tables[f"{name}.{inner}"] = schema["$defs"][deeper]
    return tables


def shapes_of(schema: Definition, name: str) -> dict[str, Definition]:
    """Return the definitions of an array of shapes, by shape."""
    mapping = schema["properties"][name]["items"]["discriminator"]["mapping"]
    return {shape: schema["$defs"][mapping[shape].rsplit("/", 1)[1]] for shape in SHAPES}


def lists_of(schema: Definition) -> dict[str, Definition]:
    """Return the arrays of tables of a simulator's scenes by name, without shapes."""
    entries = {
        name: reference(prop.get("items", {})) for name, prop in schema["properties"].items()
    }
    return {name: schema["$defs"][target] for name, target in entries.items() if target is not None}


def shape_section(schema: Definition) -> str:
    """Return the keys that place a shape."""
    drains = shapes_of(schema, "drain")
    common = {
        key
        for key in drains["box"]["properties"]
        if all(key in other["properties"] for other in drains.values())
    }
    placing = common - {"start", "stop", "shape"}
    placed = {
        **drains["box"],
        "properties": {
            key: prop for key, prop in drains["box"]["properties"].items() if key in placing
        },
    }
    return "\n".join(
        [
            SHAPED,
            variant_table(drains, "`shape`", frozenset(common), defaults=False),
            MESHES,
            PLACED,
            table(placed),
        ]
    )


def motion_section(schema: Definition) -> str:
    """Return the kinds of motion."""
    kinds = {
        part["properties"]["kind"]["const"]: part
        for name, part in schema["$defs"].items()
        if name.endswith("Motion")
    }
    lines = [
        f"- `{kind}`: {summary(definition)[0].lower()}{summary(definition)[1:]}"
        for kind, definition in kinds.items()
    ]
    return "\n".join([MOVING, *lines, "", variant_table(kinds, "`kind`", frozenset({"kind"}))])


def material_section(liquid: Definition, sand: Definition) -> str:
    """Return the keys of material, sources and drains, without those of the shape."""
    of_shape = frozenset(shapes_of(liquid, "drain")["box"]["properties"]) - {"start", "stop"}
    arrays = {"liquid": liquid, "sand": sand, "source": liquid, "drain": liquid}
    kinds = {name: shapes_of(schema, name)["box"] for name, schema in arrays.items()}
    return f"{MATERIAL}\n{variant_table(kinds, 'of', of_shape)}"


def page() -> str:
    """Return the page."""
    installed = installed_simulators()
    liquid, sand, alone = (
        installed[name].scene_model.model_json_schema(by_alias=True)
        for name in ("fluids", "granular", "contacts")
    )
    tables, of_sand, of_bodies = tables_of(liquid), tables_of(sand), tables_of(alone)
    notes = {"time": [STEPS], "domain": [DOMAIN]}
    parts = [HEAD, "## Every scene\n"]
    for name in SHARED:
        others = {"sand": of_sand[name], "bodies alone": of_bodies[name]}
        parts += [section(name, tables[name], others), *notes.get(name, [])]
    of_shape = frozenset(shapes_of(liquid, "drain")["box"]["properties"])
    parts += [
        shape_section(liquid),
        material_section(liquid, sand),
        "## Solids\n\nA `[[solid]]` has a [shape](#shapes) and:\n",
    ]
    parts += [table(shapes_of(liquid, "solid")["box"], of_shape), motion_section(liquid), BODIES]
    parts += [
        "## Particles\n",
        "Of liquids and sand.\n",
        *(section(name, tables[name]) for name in SAMPLED),
        LIQUID,
    ]
    parts += [
        section(name, definition)
        for name, definition in tables.items()
        if name not in (*SHARED, *SAMPLED)
    ]
    parts += [
        *(section(f"[{name}]", definition) for name, definition in lists_of(liquid).items()),
        SAND,
    ]
    own = {
        key: prop
        for key, prop in of_sand["solver"]["properties"].items()
        if tables["solver"]["properties"].get(key) != prop
    }
    of_sand["solver"] = {**of_sand["solver"], "properties": own}
    parts += [
        section(name, definition)
        for name, definition in of_sand.items()
        if name not in (*SHARED, *SAMPLED)
    ]
    parts += [CONTACTS, section("solver", of_bodies["solver"])]
    parts += [section(f"[{name}]", definition) for name, definition in lists_of(alone).items()]
    return "\n".join([*parts, LIMITS]).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
