"""Cost of each model of a scene, in time per step and memory.

`warp-lcp check` estimates runs from this price list. Run `python -m warp_lcp.benchmarks.models`. In
a checkout it also writes warp_lcp/scene/models.toml and docs/models.md.
"""

from __future__ import annotations

import argparse
import gc
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np
import tomli_w
import warp as wp
from scipy.optimize import nnls

from warp_lcp.benchmarks.harness.machine import array_bytes, machine
from warp_lcp.benchmarks.harness.record import BenchmarkRecord, RecordTable, Results
from warp_lcp.benchmarks.harness.report import markdown
from warp_lcp.benchmarks.harness.timing import Figure, Options, clock
from warp_lcp.files import Tables, TableView
from warp_lcp.material.particle_simulation import ParticleSimulation
from warp_lcp.run.stepping import plan_dt
from warp_lcp.scene.models import TABLE
from warp_lcp.scene.scene import Scene, Time
from warp_lcp.scene.simulator import simulators
from warp_lcp.scene.table import validate

TITLE = "What models cost"
RESOLUTION = {2: 128, 3: 48}  # cells along the longest side of the reference scenes
FRAMES = 15  # timed frames, half a second: columns collapse and reach the other wall
# [m] width of a column of less material and the same height. It separates the cost of the material
# from that of the domain.
THIN = 0.12
QUIET = {"diagnostics": False}
REFERENCE = "{}"  # the tables of the reference scene, as text
BEGIN, END = (
    "<!-- Written by `python -m warp_lcp.benchmarks.models` down to the next mark; do not edit. "
    "-->",
    "<!-- end -->",
)


@dataclass(frozen=True)
class ModelScenes:
    """Model: tables of the reference scene with it, and of the nearest scene without.

    Tables that are not named are those of the reference.
    """

    on: Tables  # tables with the model
    off: Tables = field(default_factory=dict)  # tables without it
    unit: str = "cell"  # unit of its bytes, `cell` or `particle`
    count: int = 1  # number of its instances, each of which has the price
    frames: bool = False  # whether it works for a frame, not in a step


def offers(simulator: str, dimension: int) -> dict[str, ModelScenes]:
    """Return the models of a simulator by name."""
    ball = {"shape": "sphere", "center": [0.72, 0.16, 0.25][:dimension], "radius": 0.1}
    swaying = ball | {
        "motion": {"kind": "sinusoid", "amplitude": [0.02, 0.0, 0.0][:dimension], "period": 1.0}
    }
    bodies = [
        {"shape": "sphere", "center": [x, 0.1, 0.25][:dimension], "radius": 0.06, "density": 700.0}
        for x in (0.64, 0.78, 0.92)
    ]
    both = {
        "cut cells": ModelScenes(
            {"solid": [ball]}, {"solid": [ball], "domain": {"solids": "voxel"}}
        ),
        "moving solids": ModelScenes({"solid": [swaying]}, {"solid": [ball]}),
        # Both scenes have moving solids.
        "rigid bodies": ModelScenes({"solid": bodies}, {"solid": [swaying]}, count=len(bodies)),
        "density correction": ModelScenes({"density_correction": {}}),
        "automatic density correction": ModelScenes({"density_correction": None}),
        "reseeding": ModelScenes({"particles": {"reseed": {"every": 1}}}, unit="particle"),
        "diagnostics": ModelScenes({"output": {}}),
        "surface mesh": ModelScenes({"output": QUIET | {"surface": True}}, frames=True),
    }
    if simulator == "granular":
        return both
    level_set: Tables = {"pressure": {}}
    sticky: Tables = {"domain": {"wall": "sticky"}}
    thick: Tables = {"value": 1e3}
    middle = [0.5, 0.1, 0.25][:dimension]
    probes = [
        {"name": name, "position": middle, "quantity": name}
        for name in ("pressure", "velocity", "level")
    ]
    liquid = {
        "separating walls": ModelScenes({"domain": {"wall": "separating"}}),
        "ghost-fluid surface": ModelScenes(level_set),
        "smoothing": ModelScenes({"pressure": {"smoothing": 2}}, level_set),
        "unilateral pressure": ModelScenes({"pressure": {"model": "unilateral"}}, level_set),
        "viscosity": ModelScenes({"viscosity": {"value": 10.0, "splitting_tolerance": math.inf}}),
        # Thick enough that every step is solved at once; it then replaces the viscous solve.
        "coupled solve": ModelScenes(
            sticky | {"viscosity": thick},
            sticky | {"viscosity": thick | {"splitting_tolerance": math.inf}},
        ),
        "surface tension": ModelScenes(
            level_set | {"surface_tension": {"coefficient": 0.072}}, level_set
        ),
        "drag along walls": ModelScenes({"wall_drag": {"coefficient": 5e-3}}),
        "forces on solids": ModelScenes(
            {"solid": [ball], "output": QUIET | {"forces": True}}, {"solid": [ball]}
        ),
        "probes": ModelScenes({"probe": probes}),
        "automatic tolerance": ModelScenes({"solver": {"tolerance": "auto"}}),
        "narrow band": ModelScenes(
            level_set | {"particles": {"narrow_band": {"width": 4.0}}}, level_set
        ),
        # With the default rates; its own particles are not counted as the liquid's.
        "whitewater": ModelScenes(level_set | {"whitewater": {}}, level_set),
        "FLIP": ModelScenes(
            {"particles": {"transfer": "flip"}}, {"particles": {"transfer": "pic"}}, unit="particle"
        ),
    }
    return liquid | both


def reference(
    simulator: str, dimension: int, tables: Tables, size: int, *, width: float = 0.55
) -> Scene:
    """Return the reference scene: a column in a box twice as long as high.

    Tables may be changed, or removed by None.
    """
    scene: Tables = {
        "scene": {"simulator": simulator, "name": "reference"},
        "time": {"duration": 10.0},
        "domain": {"size": [1.0, 0.5, 0.5][:dimension], "resolution": size},
        "output": QUIET,
        "density_correction": {"every": 0},
    }
    if simulator == "fluids":
        scene["domain"]["wall"] = "free-slip"
        scene["pressure"] = {"surface": "voxel"}
    scene["liquid" if simulator == "fluids" else "sand"] = [
        {"shape": "box", "min": [0.0] * dimension, "max": [width, 0.4, 0.5][:dimension]}
    ]
    merged = scene | {
        name: scene["domain"] | value if name == "domain" else value
        for name, value in tables.items()
    }
    given = {name: value for name, value in merged.items() if value is not None}
    return validate(simulators()[simulator].scene_model, given, "reference")


def create(scene: Scene, device: str) -> ParticleSimulation:
    """Return the simulation of a scene."""
    made = simulators()[scene.scene.simulator].create(scene, device=device, folder=Path.cwd())
    assert isinstance(made, ParticleSimulation)
    return made


def run_seconds(simulation: ParticleSimulation, time: Time) -> np.ndarray:
    """Return the seconds of each step of the first frames of a run.

    Time steps are those of a run, since the number of iterations of a solve depends on them.
    """
    spent = []
    for frame in range(1, FRAMES + 1):
        while time.frame_time(frame) - simulation.time > 1e-9:
            spent.append(
                step_seconds_of(
                    simulation,
                    plan_dt(simulation.stable_dt(), time.frame_time(frame) - simulation.time, time),
                )[0]
            )
    return np.array(spent)


def step_seconds_of(simulation: ParticleSimulation, dt: float) -> tuple[float, Tables]:
    """Return the seconds of a step and its row.

    On a CPU they are CPU seconds, which other programs do not affect.
    """
    device = simulation.grid.device
    read = clock(str(device))
    wp.synchronize_device(device)
    begun = read()
    row = simulation.step(dt)
    wp.synchronize_device(device)
    return read() - begun, row


@dataclass
class SceneSample:
    """Measured scene: its bytes, and the least seconds of each of its steps.

    The steps are the same in each run.
    """

    scene: Scene
    bytes: int
    steps: np.ndarray

    @property
    def seconds(self) -> float:
        """Mean seconds of a step."""
        return float(self.steps.mean())

    def again(self, steps: np.ndarray) -> None:
        """Keep the shorter times of this and another run.

        Rounding on GPUs may change the number of steps; then only the steps of both count.
        """
        count = min(len(self.steps), len(steps))
        self.steps = np.minimum(self.steps[:count], steps[:count])


def first_run(scene: Scene, device: str) -> SceneSample:
    """Return a scene's bytes and seconds of one run.

    Memory of other simulations is freed first.
    """
    gc.collect()
    before = array_bytes()
    simulation = create(scene, device)
    steps = run_seconds(simulation, scene.time)
    simulation.surfaces()
    gc.collect()
    return SceneSample(scene, array_bytes() - before, steps)


def measure_all(
    simulator: str, dimension: int, size: int, options: Options
) -> dict[str, SceneSample]:
    """Return samples of the reference and all models' scenes, by their tables' text.

    The runs take turns.
    """
    wanted: dict[str, Tables] = {REFERENCE: {}}
    for offer in offers(simulator, dimension).values():
        wanted |= {str(tables): tables for tables in (offer.on, offer.off)}
    samples: dict[str, SceneSample] = {}
    for text, tables in wanted.items():
        scene = reference(simulator, dimension, tables, size)
        # Loads kernels and data that are no part of a scene's cost.
        create(scene, options.device).step(1e-3)
        samples[text] = first_run(scene, options.device)
    for _ in range(options.repeat - 1):
        for sample in samples.values():
            sample.again(run_seconds(create(sample.scene, options.device), sample.scene.time))
    return samples


def split(seconds: float, half: float, dimension: int) -> tuple[float, float]:
    """Split the seconds of a step into a fixed part and one that grows with the size.

    `half` is the time at half the resolution.
    """
    ratio = 2**dimension
    fixed = min(max((ratio * half - seconds) / (ratio - 1), 0.0), max(seconds, 0.0))
    return fixed, max(seconds - fixed, 0.0)


def split_base(
    base: SceneSample, half: SceneSample, thin: SceneSample
) -> tuple[float, float, float]:
    """Return the seconds of a step: fixed, per cell and per particle.

    They are fitted by nonnegative least squares to three scenes of other sizes and amounts of
    material.
    """
    scenes = [(base, counts(base.scene)), (half, counts(half.scene)), (thin, counts(thin.scene))]
    rows = np.array([[1.0, *count] for _, count in scenes]) / np.array(
        [[sample.seconds] for sample, _ in scenes]
    )
    scale = np.abs(rows).max(axis=0)
    found = nnls(rows / scale, np.ones(3))[0] / scale
    return float(found[0]), float(found[1]), float(found[2])


def counts(scene: Scene) -> tuple[int, int]:
    """Return the numbers of cells and particles of a reference scene."""
    simulation = create(scene, "cpu")
    return math.prod(simulation.grid.counts), simulation.particles.count


def records_of(simulator: str, dimension: int, options: Options) -> list[BenchmarkRecord]:
    """Measure a simulator's models."""
    options.say(f"{simulator}, {dimension}-D")
    size = max(options.sizes, default=RESOLUTION[dimension])
    samples, halves = (measure_all(simulator, dimension, n, options) for n in (size, size // 2))
    base = samples[REFERENCE]
    thin = first_run(reference(simulator, dimension, {}, size, width=THIN), options.device)
    cells, particles = counts(base.scene)
    fixed, cell, particle = split_base(base, halves[REFERENCE], thin)
    share = particle * particles / max(cell * cells + particle * particles, 1e-12)
    figures = {
        "step": Figure(base.seconds, "s"),
        "fixed_seconds": Figure(fixed, "s"),
        "cell_seconds": Figure(cell, "s"),
        "particle_seconds": Figure(particle, "s"),
        "cell_bytes": Figure(base.bytes / cells, "B"),
    }
    facts = {"cells": cells, "particles": particles}
    records = [BenchmarkRecord(f"{simulator} {dimension}d: base", figures, facts)]
    for name, offer in offers(simulator, dimension).items():
        on, off, many = str(offer.on), str(offer.off), {"cell": cells, "particle": particles}
        added, added_half = (
            (s[on].seconds - s[off].seconds) / offer.count for s in (samples, halves)
        )
        fixed, growing = (0.0, 0.0) if offer.frames else split(added, added_half, dimension)
        figures = {
            "step": Figure(added, "s"),
            "fixed_seconds": Figure(fixed, "s"),
            "cell_seconds": Figure((1.0 - share) * growing / cells, "s"),
            "particle_seconds": Figure(share * growing / particles, "s"),
            f"{offer.unit}_bytes": Figure(
                (samples[on].bytes - samples[off].bytes) / many[offer.unit] / offer.count, "B"
            ),
        }
        records.append(
            BenchmarkRecord(
                f"{simulator} {dimension}d: {name}", figures, facts | {"frames": offer.frames}
            )
        )
    return records


def measure(options: Options, out: Path) -> Results:
    """Measure all models of both simulators."""
    records = [machine(options.device, elements=1 << 22, repeat=options.repeat)]
    tables = []
    for simulator in ("fluids", "granular"):
        for dimension in (3, 2):
            found = records_of(simulator, dimension, options)
            records += found
            tables.append(table_of(simulator, dimension, found))
    return Results(records, tables)


def table_of(simulator: str, dimension: int, records: list[BenchmarkRecord]) -> RecordTable:
    """Return the table of a simulator's prices."""
    base = records[0]
    whole = base.figures["step"].value
    rows = []
    for record in records:
        name, step = record.name.split(": ")[1], record.figures["step"].value
        unit = "particle" if "particle_bytes" in record.figures else "cell"
        added = "in frames only" if record.facts.get("frames") else f"{1e3 * step:.2f}"
        part = "" if record.facts.get("frames") else f"{100.0 * step / whole:.0f} %"
        rows.append([name, added, part, f"{record.figures[f'{unit}_bytes'].value:.1f} a {unit}"])
    what = "liquid" if simulator == "fluids" else "sand"
    remark = (
        f"A column of {what}, {base.facts['cells']:,} cells and {base.facts['particles']:,} "
        "particles. `base` is the scene without any "
        "model, particles and all; the others say what they add to it, to some percent of it: "
        "differences of short times. Each rigid body "
        "adds its own, beside what moving solids add once."
    )
    return RecordTable(
        f"{what.capitalize()}, {dimension}-D",
        ["model", "ms a step", "of base", "bytes"],
        rows,
        remark,
    )


def price_list(records: list[BenchmarkRecord]) -> TableView:
    """Return the contents of `warp_lcp/scene/models.toml`.

    It holds the fields of `warp_lcp.scene.models.ModelCost` by simulator, dimension and model.
    """
    listed: Tables = {}
    for record in records:
        where, separator, name = record.name.partition(": ")
        if not separator:
            continue
        simulator, dimension = where.split()
        price = {
            key: float(f"{figure.value:.3g}")
            for key, figure in record.figures.items()
            if key.endswith(("_seconds", "_bytes"))
        }
        listed.setdefault(simulator, {}).setdefault(dimension, {})[name] = price
    return listed


def overview(records: Sequence[BenchmarkRecord]) -> RecordTable:
    """Return the prices of all models in 3-D.

    The columns are time per step as a share of `base`, and memory.
    """
    columns = {"fluids 3d": "liquid", "granular 3d": "sand"}
    priced = {record.name: record for record in records if ": " in record.name}
    names = list(dict.fromkeys(name.split(": ")[1] for name in priced))
    rows = []
    for model in names:
        row = [model]
        for place in columns:
            record, base = priced.get(f"{place}: {model}"), priced[f"{place}: base"]
            row.append("" if record is None else _price(record, base))
        rows.append(row)
    return RecordTable("Prices", ["model", *columns.values()], rows)


def _price(record: BenchmarkRecord, base: BenchmarkRecord) -> str:
    """Return the added time per step and memory of a model, or those of `base`."""
    step, unit = (
        record.figures["step"].value,
        "particle" if "particle_bytes" in record.figures else "cell",
    )
    memory = (
        f"{record.figures[f'{unit}_bytes'].value:.0f} "
        f"B{' a particle' if unit == 'particle' else ''}"
    )
    if record is base:
        return f"{1e3 * step:.1f} ms, {memory}"
    return (
        f"frames only, {memory}"
        if record.facts.get("frames")
        else f"{100.0 * step / base.figures['step'].value:.0f} %, {memory}"
    )


def write_page(page: Path, results: Results) -> None:
    """Write the table into the page of the documentation, between its two marks."""
    head, _, rest = page.read_text("utf-8").partition(BEGIN)
    table = "\n".join(markdown(overview(results.records)))
    told = f"One core of {results.records[0].facts['hardware']['cpu']}."
    page.write_text(f"{head}{BEGIN}\n{told}\n\n{table}\n{END}{rest.partition(END)[2]}", "utf-8")


def main() -> None:
    """Measure, and write the price list and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--page", type=Path, default=Path("docs/models.md"))
    arguments = parser.parse_args()
    options = Options(
        arguments.device, (), arguments.repeat, lambda text: sys.stderr.write(f"{text}\n")
    )
    results = measure(options, Path())
    head = (
        "# What models add to a step and to memory, by simulator and dimension; written by "
        "`python -m warp_lcp.benchmarks.models`.\n\n"
    )
    Path(str(files("warp_lcp.scene") / TABLE)).write_text(
        head + tomli_w.dumps(price_list(results.records)), "utf-8"
    )
    write_page(arguments.page, results)


if __name__ == "__main__":
    main()
