"""Command line: the program `warp-lcp` and its commands.

A command imports simulators, renderers and methods when it runs, so that help texts, completion and
messages about wrong arguments come at once.
"""

from __future__ import annotations

import glob
import json
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
import warp as wp

from warp_lcp.cli.exit_codes import FAILED, WRONG_INPUT, end, wrong_input
from warp_lcp.cli.suites import benchmarks, suite_names
from warp_lcp.cli.view_commands import export, render, serve, show_while_running, view
from warp_lcp.default_chain import default_chain
from warp_lcp.files import Tables
from warp_lcp.kernels.thread_pool import get_threads, set_threads
from warp_lcp.problem.operator_protocol import families
from warp_lcp.run.devices import RANK_TIMEOUT, Engine, choose_device, cuda_driver, devices, versions
from warp_lcp.run.terminal import CommandGroup, Terminal, print_lines, print_text, table_lines
from warp_lcp.scene.presets import TRIAL_FRAMES, PresetName
from warp_lcp.settings import nearest
from warp_lcp.simulation import InputError, SimulationFailed, StepFailed
from warp_lcp.solvers.projected_multigrid import ProjectedMultigrid
from warp_lcp.solvers.registry import METHODS

if TYPE_CHECKING:
    from warp_lcp.cli.solve_file import FileOutcome
    from warp_lcp.run.folder import RunRecord
    from warp_lcp.run.launcher import Launcher
    from warp_lcp.run.tune import TuningResult

RANKED_SUITE = "scaling"  # suite of `bench --engine petsc`

app = typer.Typer(
    name="warp-lcp",
    cls=CommandGroup,
    help="Complementarity solvers and simulators. Exit codes: 0 success, 1 failed or stopped, 2 "
    "wrong input.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@contextmanager
def launcher_of(engine: Engine, *, rank_timeout: float) -> Iterator[Launcher]:
    """Yield the launcher of a command: one process, or the ranks together.

    Args:
        engine: engine that runs the command.
        rank_timeout: longest time that ranks wait for one of them [s]; 0: no limit.

    Raises:
        EngineError: the engine cannot be used here.
    """
    from warp_lcp.run.launcher import Launcher

    if engine is Engine.SINGLE:
        yield Launcher()
        return
    from warp_lcp.run.rank_launcher import ranks_together  # needs MPI and PETSc

    with ranks_together(rank_timeout) as launcher:
        yield launcher


def _matching_names(word: str, names: Iterable[str]) -> list[str]:
    return sorted(name for name in names if name.startswith(word))


def _scenes_alike(incomplete: str) -> list[str]:
    """Return completions of a scene: built-in scenes, scene files and folders."""
    from warp_lcp.scene.scene_file import built_in_scenes

    near = (
        sorted(Path().glob(f"{glob.escape(incomplete)}*"))
        if not Path(incomplete).is_absolute()
        else []
    )
    folders, scene_files = (
        [f"{path}/" for path in near if path.is_dir()],
        [str(path) for path in near if path.suffix == ".toml"],
    )
    return [*_matching_names(incomplete, built_in_scenes()), *scene_files, *folders]


def _suites_alike(incomplete: str) -> list[str]:
    return _matching_names(incomplete, suite_names())


def _methods_alike(incomplete: str) -> list[str]:
    return _matching_names(
        incomplete, [name for name, method in METHODS.items() if families(method)]
    )


SceneArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENE",
        help="Scene file, or name of a built-in scene (see `warp-lcp scenes`).",
        autocompletion=_scenes_alike,
    ),
]
EngineOption = Annotated[
    Engine,
    typer.Option(
        help="single: this process; petsc: MPI ranks of `mpiexec -n N warp-lcp ...` (needs "
        "petsc4py and mpi4py)."
    ),
]
RankTimeout = Annotated[
    float,
    typer.Option(
        min=0.0,
        metavar="S",
        help="Abort all ranks and name the late one after S seconds of waiting; 0: no limit.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        help="Override a scene key; repeatable. Entry of an array: liquid.0.max=[1,1].",
    ),
]

ThreadsOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="CPU threads; results do not depend on them. Default: WARP_LCP_THREADS, else all "
        "cores.",
        show_default=False,
    ),
]
ForceMemory = Annotated[
    bool,
    typer.Option(
        "--force-memory",
        help="Do not check whether the run fits into the free memory of the device.",
    ),
]


def _print_version(asked: bool) -> None:
    if asked:
        print_lines(versions()["warp-lcp"])
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Define the options of the program itself."""


def main() -> None:
    """Run the command line on the process's own arguments."""
    app()


@app.command()
def run(
    scene: Annotated[
        str | None,
        typer.Argument(
            metavar="SCENE",
            help="Scene file, or name of a built-in scene (see `warp-lcp scenes`); optional with "
            "--resume --out DIR.",
            show_default=False,
            autocompletion=_scenes_alike,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Run folder. Default: out/NAME.", show_default=False)
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(help="cpu or cuda:N. Default: a GPU, if there is one.", show_default=False),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Stop after frame N.", show_default=False)
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the run in the folder from its newest checkpoint, with its earlier "
            "--set values.",
        ),
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Delete an earlier run in the folder first.")
    ] = False,
    force_memory: ForceMemory = False,
    profile: Annotated[
        bool,
        typer.Option(
            "--profile", help="Measure the time of each part; print it and write profile.json."
        ),
    ] = False,
    record_problems: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write the pressure problem of each step to DIR.",
            show_default=False,
        ),
    ] = None,
    page: Annotated[
        bool,
        typer.Option(
            "--serve", help="Show the run on a web page while it is in progress, as `serve` does."
        ),
    ] = False,
    window: Annotated[
        bool, typer.Option("--view", help="Show the run in a window, as `view` does.")
    ] = False,
    engine: EngineOption = Engine.SINGLE,
    rank_timeout: RankTimeout = RANK_TIMEOUT,
    threads: ThreadsOption = None,
    overrides: SetOption = None,
) -> None:
    """Simulate a scene; ParaView opens the frames in the run folder."""
    from warp_lcp.extras.viewer import check_window
    from warp_lcp.run.folder import BEFORE, OutputError, mark_ended
    from warp_lcp.run.interruption import Interruption
    from warp_lcp.run.launcher import default_folder
    from warp_lcp.run.loop import RunRequest
    from warp_lcp.run.profile import Profiler
    from warp_lcp.run.progress import ProgressBar, ProgressLines

    options = {
        "--out": out,
        "--device": device,
        "--frames": frames,
        "--resume": resume,
        "--force": force,
        "--force-memory": force_memory,
    }
    with wrong_input(), launcher_of(engine, rank_timeout=rank_timeout) as launcher:
        _use_threads(threads)
        if resume and force:
            raise OutputError(
                "--resume and --force exclude each other: --resume continues a run, --force "
                "deletes it"
            )
        loaded = launcher.load(scene, overrides or (), options)
        chosen_device, console = launcher.choose_device(device), launcher.console
        folder, name = out or default_folder(loaded.scene), loaded.scene.scene.name
        print_text(console, f"{name} on {launcher.place(chosen_device)}, into {folder}")
        if loaded.kept:
            print_text(console, f"earlier --set values: {', '.join(loaded.kept)}")
        request = RunRequest(
            scene=loaded.scene,
            out=folder,
            device=chosen_device,
            overrides=loaded.overrides,
            last_frame=frames,
            resume=resume,
            force=force,
            force_memory=force_memory,
            record_problems=record_problems,
        )
        at_once = launcher.ranks is None

        def last(name: str) -> None:
            mark_ended(folder, "stopped", f"interrupted by {name} {BEFORE}")

        if window:
            check_window(folder)
        stop = Interruption(partial(print_text, console), at_once=at_once, last=last)
        with (
            stop,
            ProgressBar(console) if console.is_terminal else ProgressLines(console) as observer,
        ):
            watch = Profiler(chosen_device) if profile and launcher.is_root else None
            with show_while_running(
                observer, folder, page=page and launcher.is_root, window=window and launcher.is_root
            ) as observers:
                record = launcher.run(request, observer=observers, stop=stop, profile=watch)
    if not launcher.is_root:
        raise typer.Exit(0 if record.status == "finished" else FAILED)
    if watch:
        print_lines(watch.table(record.steps - (record.resumed_from_step or 0), record.seconds))
    _report(record, folder)


for command in (render, view, serve, export):  # after `run` in the list of commands
    app.command()(command)


@app.command()
def check(
    scene: SceneArgument,
    device: Annotated[
        str | None,
        typer.Option(help="cpu or cuda:N: the device whose memory is checked.", show_default=False),
    ] = None,
    calibrate: Annotated[
        bool,
        typer.Option("--calibrate", help="Also run a few steps and measure the time per step."),
    ] = False,
    fix: Annotated[
        bool, typer.Option("--fix", help="First replace old key names in the scene file.")
    ] = False,
    force_memory: ForceMemory = False,
    overrides: SetOption = None,
) -> None:
    """Validate a scene; estimate memory and run time; list suspicious settings."""
    from warp_lcp.material.particle_scene import ParticleScene
    from warp_lcp.run.check import check_memory, check_scene, start
    from warp_lcp.run.estimate import doubts, estimate_run
    from warp_lcp.run.trial import step_seconds
    from warp_lcp.scene.scene_file import fix_file

    with wrong_input():
        chosen_device = choose_device(device)
        if fix:
            _print_pairs(
                [("fixed", line) for line in fix_file(scene) or ["nothing: no key has an old name"]]
            )
        loaded, lines = check_scene(scene, overrides or ())
        _print_pairs(lines)
        if not force_memory:
            check_memory(loaded, chosen_device)
            beginning = start(loaded, chosen_device)
            _print_pairs(
                [("note", note) for note in (*beginning.notes(), *doubts(loaded, beginning))]
            )
            if not calibrate:
                _print_pairs(estimate_run(loaded, beginning))
        if not calibrate:
            return
        try:
            seconds, steps = step_seconds(loaded, device=chosen_device)
        except (StepFailed, SimulationFailed) as error:
            end(str(error), FAILED)
    _print_pairs(
        [("seconds a step", f"about {seconds:.3g} on {chosen_device}, the median of {steps}")]
    )
    if not force_memory:
        _print_pairs(estimate_run(loaded, beginning, seconds))
    if isinstance(loaded, ParticleScene):
        _print_pairs(loaded.model_plan(seconds))


@app.command("tune")
def tune_scene(
    scene: SceneArgument,
    accuracy: Annotated[
        PresetName, typer.Option(help="Target accuracy: the preset whose error to match.")
    ] = "standard",
    frames: Annotated[
        int, typer.Option(min=1, metavar="N", help="Number of frames of each trial run.")
    ] = TRIAL_FRAMES,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File for the tuned scene.", show_default=False),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(help="cpu or cuda:N: the device that will run the scene.", show_default=False),
    ] = None,
    overrides: SetOption = None,
) -> None:
    """Find the fastest settings of a scene for an accuracy, by short trial runs."""
    from warp_lcp.run.check import check_memory
    from warp_lcp.run.folder import OutputError
    from warp_lcp.run.tune import tune, write_tuned
    from warp_lcp.scene.scene_file import load_scene

    with wrong_input():
        chosen_device = choose_device(device)
        loaded = load_scene(scene, overrides or ())
        if out is not None and (out.is_dir() or not out.parent.is_dir()):
            raise OutputError(f"--out {out}: must be a file in an existing folder")
        check_memory(loaded, chosen_device)
        try:
            tuning = tune(
                loaded,
                accuracy=accuracy,
                device=chosen_device,
                frames=frames,
                say=partial(print_text, Terminal(stderr=True)),
            )
        except (StepFailed, SimulationFailed) as error:
            end(str(error), FAILED)
        if out is not None:
            try:
                write_tuned(out, tuning, accuracy, chosen_device)
            except OSError as error:
                raise OutputError(f"--out {out}: {error}") from error
    _print_tuning(tuning, accuracy, chosen_device)


@app.command()
def scenes() -> None:
    """List the built-in scenes with their descriptions."""
    from warp_lcp.scene.scene_file import built_in_scenes, load_scene

    with wrong_input():
        _print_pairs([(name, load_scene(name).scene.description) for name in built_in_scenes()])


@app.command()
def schema(
    simulator: Annotated[
        str, typer.Option(help="Simulator whose scenes the schema describes.")
    ] = "fluids",
) -> None:
    """Print the JSON schema of scene files, for editors and other programs."""
    from warp_lcp.scene.scene_file import installed_simulators

    with wrong_input():
        installed = installed_simulators()
    if simulator not in installed:
        end(
            f"--simulator {simulator}: no such simulator; {nearest(simulator, installed)}",
            WRONG_INPUT,
        )
    print_lines(
        json.dumps(installed[simulator].scene_model.model_json_schema(by_alias=True), indent=2)
    )


@app.command()
def solve(
    problem: Annotated[
        Path,
        typer.Argument(
            metavar="PROBLEM",
            help="Matrix A as a Matrix Market file A.mtx, or a recorded problem_STEP.npz of a "
            "grid.",
        ),
    ],
    right_side: Annotated[
        Path | None,
        typer.Argument(metavar="[b.mtx]", help="Vector b, Matrix Market.", show_default=False),
    ] = None,
    lower: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER|FILE",
            help="Lower bounds of x; -inf: none. Default: 0.",
            show_default=False,
        ),
    ] = None,
    upper: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER|FILE", help="Upper bounds of x. Default: inf.", show_default=False
        ),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Method by name, such as psor. Default: the fastest for A.",
            show_default=False,
            autocompletion=_methods_alike,
        ),
    ] = None,
    tolerance: Annotated[
        float,
        typer.Option(
            metavar="T",
            help="Tolerance of the residual, relative to the residual at clip(0, lower, upper).",
        ),
    ] = 1e-6,
    max_iterations: Annotated[
        int, typer.Option(metavar="N", help="Maximum number of iterations.")
    ] = 1000,
    max_seconds: Annotated[
        float,
        typer.Option(
            metavar="S",
            help="Maximum wall time of the solve in seconds. Default: no limit.",
            show_default=False,
        ),
    ] = math.inf,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="File for x: x.mtx, or x.npy for a grid.", show_default=False
        ),
    ] = None,
    device: Annotated[
        str, typer.Option(help="cpu or cuda:N; with --engine petsc: cpu or cuda.")
    ] = "cpu",
    engine: EngineOption = Engine.SINGLE,
    rank_timeout: RankTimeout = RANK_TIMEOUT,
) -> None:
    """Solve y = A x + b, lower <= x <= upper, from files or a recorded problem."""
    from warp_lcp.cli.solve_file import solve_files
    from warp_lcp.cli.solve_recorded import SUFFIX, check_recorded, file_digest, solve_recorded
    from warp_lcp.run.problem_folder import ProblemError

    options: Tables = {
        "method": method,
        "tolerance": tolerance,
        "max_iterations": max_iterations,
        "max_seconds": max_seconds,
    }
    with wrong_input(), launcher_of(engine, rank_timeout=rank_timeout) as launcher:
        launcher.agree(
            {"the problem": file_digest(problem), "--out": out, "--device": device, **options}
        )
        chosen_device = launcher.choose_device(device)
        if out is not None and not out.parent.is_dir():
            raise ProblemError(f"--out {out}: no such folder: {out.parent}")
        if out is not None and out.is_dir():
            raise ProblemError(f"--out {out}: is a folder; name a file")
        outcome: FileOutcome
        if problem.suffix == SUFFIX:
            check_recorded(problem, right_side=right_side, lower=lower, upper=upper, out=out)
            outcome = solve_recorded(problem, device=chosen_device, ranks=launcher.ranks, **options)
        elif engine is Engine.PETSC:
            raise ProblemError(
                f"{problem}: --engine petsc solves only grid problems, as written by `warp-lcp run "
                "--record-problems`"
            )
        elif right_side is None:
            raise ProblemError(
                f"{problem}: is a matrix: b is missing; write warp-lcp solve A.mtx b.mtx"
            )
        else:
            outcome = solve_files(
                problem,
                right_side,
                device=chosen_device,
                lower=lower or "0",
                upper=upper or "inf",
                **options,
            )
        if out is not None:
            outcome.write(out)
    if not launcher.is_root:
        raise typer.Exit(0 if outcome.result else FAILED)
    console = Terminal(soft_wrap=True, highlight=False)
    print_text(console, outcome.heading())
    console.print(outcome.table())
    if not outcome.result:
        end(outcome.ending(), FAILED)
    print_text(console, outcome.ending())


@app.command()
def bench(
    suite: Annotated[
        str,
        typer.Argument(
            metavar="SUITE", help=f"{', '.join(suite_names())}.", autocompletion=_suites_alike
        ),
    ],
    scene: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENE]",
            help="Scene of the suite tradeoff. Default: its own.",
            show_default=False,
            autocompletion=_scenes_alike,
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="cpu or cuda:N.")] = "cpu",
    out: Annotated[Path, typer.Option(help="Folder for SUITE.json, SUITE.md and plots.")] = Path(
        "out/bench"
    ),
    size: Annotated[
        list[int] | None,
        typer.Option(metavar="N", help="Cells along a side; repeatable.", show_default=False),
    ] = None,
    repeat: Annotated[
        int, typer.Option(min=1, metavar="K", help="Number of samples of each timing.")
    ] = 5,
    engine: Annotated[
        Engine,
        typer.Option(
            help="petsc: scaling on 1, 2 and 4 ranks, or on the ranks of `mpiexec -n N warp-lcp "
            "...`."
        ),
    ] = Engine.SINGLE,
    seed: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="First seed of random problems, for choose and extremes. Default: the suite's.",
            show_default=False,
        ),
    ] = None,
    compare: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            metavar="A.json B.json",
            help="Compare two result files instead of measuring.",
            show_default=False,
        ),
    ] = None,
    threads: ThreadsOption = None,
) -> None:
    """Run benchmarks, or compare two results.

    First prints the expected time on two cores and the packages needed.
    """
    from warp_lcp.scene.scene_file import load_scene

    installed = benchmarks()
    if suite not in installed:
        end(f"{suite}: no such suite; {nearest(suite, installed)}", WRONG_INPUT)
    with wrong_input():
        _use_threads(threads)
        # Ranks choose their devices themselves.
        chosen_device = device if engine is Engine.PETSC else choose_device(device)
        if scene:
            load_scene(scene)
    shared = engine is Engine.PETSC
    if shared and suite != RANKED_SUITE:
        end(
            f"--engine petsc: the suite {suite} measures one process; use {RANKED_SUITE}",
            WRONG_INPUT,
        )
    try:
        if compare is not None:
            print_lines(installed[suite].compare(*compare))
            return
        options: Tables = ({"scene": scene} if scene else {}) | (
            {} if seed is None else {"seed": seed}
        )
        if not shared:  # called on every rank
            print_lines(f"{suite}: takes about {installed[suite].takes}", error=True)
        files = installed[suite].run(
            device=chosen_device,
            out=out,
            sizes=tuple(size or ()),
            repeat=repeat,
            shared=shared,
            threads=threads,
            **options,
        )
    except ValueError as error:
        end(str(error), WRONG_INPUT)
    except RuntimeError as error:
        end(str(error), FAILED)
    for file in files:
        print_lines(file)


@app.command()
def info() -> None:
    """Print versions, devices, simulators and the default method on grids."""
    from warp_lcp.scene.scene_file import installed_simulators

    lines = list(versions().items())
    lines += [(f"device {alias}", text) for alias, text in devices().items()]
    with wrong_input():
        _use_threads(None)
        lines.append(("CPU threads", f"{get_threads()}; set by --threads or WARP_LCP_THREADS"))
    lines += [("CUDA driver", cuda_driver()), ("kernel cache", str(wp.config.kernel_cache_dir))]
    lines.append(("default on grids", str(default_chain(ProjectedMultigrid()))))
    _print_pairs(lines)
    with wrong_input():
        _print_pairs(
            [
                (f"simulator {name}", simulator.summary)
                for name, simulator in installed_simulators().items()
            ]
        )


def _use_threads(count: int | None) -> None:
    try:
        get_threads() if count is None else set_threads(count)
    except ValueError as error:
        raise InputError(str(error).replace("count:", "--threads:")) from None


def _print_tuning(tuning: TuningResult, accuracy: str, device: str) -> None:
    """Print the measurements and the fastest settings."""
    rows = tuning.rows()
    print_lines(table_lines(rows[0], rows[1:], left=range(len(rows[0]))))
    print_lines(
        f"{tuning.frames} frames on {device}; distance: displaced fraction of the mass; reference: "
        f"{tuning.reference.steps} steps"
    )
    for line in tuning.verdict(accuracy):
        print_lines(line)


def _print_pairs(pairs: list[tuple[str, str]]) -> None:
    for word, line in pairs:
        print_lines(f"{word:<20}  {line}")


def _report(record: RunRecord, folder: Path) -> None:
    """Print the exit status of a run."""
    summary = f"{record.steps} steps, {record.time:.6g} s simulated in {record.seconds:.1f} s"
    if record.status == "finished" and record.steps and record.resumed_from_step == record.steps:
        print_lines(
            f"finished earlier, nothing to do: {record.reason}; {record.steps} steps, "
            f"{record.time:.6g} s simulated, in {folder}"
        )
        return
    if record.status == "finished":
        print_lines(
            f"finished: {record.reason}; {summary}; ParaView opens the .pvd files in {folder}"
        )
        return
    message = (
        f"{record.status}: {record.reason}\n{summary}; frames 0 to {record.frames} are in {folder}"
    )
    newest = max(
        folder.glob("checkpoints/step_*.npz"),
        key=lambda file: int(file.stem.removeprefix("step_")),
        default=None,
    )
    if newest is None:
        end(f"{message}; there is no checkpoint yet", FAILED)
    again = f"warp-lcp run {folder / 'scene.toml'} --out {folder} --device {record.device} --resume"
    if record.engine != Engine.SINGLE:
        again = f"mpiexec -n {record.ranks} {again} --engine {record.engine}"
    end(f"{message}\nlast checkpoint: {newest}\ncontinue with: {again}", FAILED)
