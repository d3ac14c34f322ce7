"""Plain words in docstrings, help texts, messages and documentation."""

import ast
import inspect
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
import typer

import warp_lcp as wl
from parsed_sources import classes, functions, parsed
from warp_lcp import gallery
from warp_lcp.cli.commands import app

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "docs" / "design").glob("*.md"),
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
    ]
)
LONGEST = 80  # characters of a summary line
# A summary line begins with a noun or a verb.
RIDDLES = {"what", "which", "how", "who", "that", "in", "of", "where", "when"}

# Old names and phrases, each with the plain one that replaces it.
REPLACED = {
    r"\bangle_of\b": "friction_angle_test",
    r"\bConvexSetProblem\b": "VariationalInequality",
    r"\bcrowding\b": "density correction, density monitor",
    r"\bforetell": "estimate",
    r"\b(laid|made|cut) anew\b": "rebuilt, repartitioned",
    r"\bhardly meant\b": "suspicious settings",
    r"\blets? go of\b": "separates from",
    r"\bis yours to know\b": "you must know",
    r"\bGood company\b": "sharing a machine",
    r"\btaken for no digits\b": "are not significant digits",
    r"\bin turns: ": "interleaved sampling",
    r"\bHow near is at\b": "at its bound",
    r"\bnobody asks\b": "is off",
    r"\bhas the word\b": "decides",
    r"\bshows no rows\b": "gives no access to rows",
}


# Older names of classes, without a leading underscore, each with the one that replaces it.
OLDER_CLASSES = {
    "Beginning": "SolveStart",
    "Begun": "_StepStart",
    "Block": "StridedBox",
    "Boxes": "_BoundsCache",
    "Column": "ParticleArray",
    "Complaint": "CrossKeyError",
    "Crossings": "SelfIntersections",
    "Cube": "DualCell",
    "Descent": "EnergyMonitor",
    "Drag": "WallDragFields",
    "Dress": "MeshConversion",
    "Extent": "LaunchDimensions",
    "FieldsOnHost": "DataclassPickling",
    "Finish": "SurfaceFinish",
    "Flight": "FragmentFields",
    "FoundContacts": "DetectedContacts",
    "GathersFields": "FieldGather",
    "Ghosts": "GhostExchange",
    "HasType": "HasDataType",
    "Holds": "FormatSupport",
    "Identified": "KeyedArgument",
    "Joined": "HasPieces",
    "KeepsWorkspace": "HasWorkspaceCache",
    "Kept": "WorkspaceCache",
    "Look": "MaterialSnapshot",
    "Looks": "ImageStyle",
    "Marks": "FaceMarks",
    "Masks": "HasPrincipalSystem",
    "Measured": "HasTables",
    "MethodOfChoice": "RegistryContactMethod",
    "Moved": "CompletedStep",
    "Moving": "MovingSolids",
    "Multiplies": "SupportsMatmul",
    "NamesComponents": "HasFloatingComponents",
    "Nearest": "NearestSolids",
    "Numbered": "CellNumbering",
    "OfAnyShape": "ShapeUnion",
    "OneProcess": "SerialCommunicator",
    "OnHost": "HostArrayPickle",
    "OptionalMembers": "WorkspaceDefaults",
    "Parts": "GridComponents",
    "PathCreeps": "CentralPathStalls",
    "PatientMethod": "EnergyDescentMethod",
    "Pickled": "HostPickling",
    "Place": "UncheckedPose",
    "Placed": "RigidTransform",
    "PlaceOrder": "SummationOrder",
    "Places": "IncidenceFields",
    "Planned": "_PlannedSolve",
    "Plant": "PlantedSolution",
    "Profiled": "HasStages",
    "Recorded": "HasRecordedProblems",
    "Refill": "GhostLayerExchange",
    "Relaxes": "HasSweep",
    "RenderLook": "ImageRenderer",
    "Replicates": "HasReplica",
    "Resampled": "HasResampling",
    "Scheduled": "HasEvents",
    "Show": "VisiblePart",
    "Sites": "JitteredLattice",
    "Spare": "ReusableWorkspace",
    "SpareChain": "CachedChain",
    "StartsAfter": "HasInitAfter",
    "StoresRounded": "HasStorageRounding",
    "Substitute": "FallbackSystem",
    "Sums": "RowReduction",
    "Tally": "DynamicReduction",
    "TimeIsUp": "DeadlineReached",
    "Traits": "ProblemProperties",
    "Transposes": "HasTranspose",
    "TreesAtCuts": "FragmentMerger",
    "Turns": "_RotationCurve",
    "Versioned": "HasVersion",
    "Waiting": "_StretchQueue",
    "WallPull": "ViscousWallCoupling",
    "WindowTally": "WindowReduction",
}
# Older names of functions and methods.
OLDER_FUNCTIONS = {
    "adding": "sum_operation",
    "appended": "register_append",
    "_assessing": "_evaluate_kernel",
    "begin_ahead": "begin_on_device",
    "_begin_ahead": "_begin_on_device",
    "begins_ahead": "begins_on_gpu",
    "_begins_ahead": "_begins_on_gpu",
    "_building": "_build_program",
    "calm": "damp_velocity_gradients",
    "coarsening": "coarsen_kernel",
    "_coarsening": "_coarsen_program",
    "collecting": "collect_task",
    "complaints": "find_errors",
    "correcting": "correct_kernel",
    "creeps": "needs_cycle",
    "_creeps": "_needs_cycle",
    "dealt": "device_by_number",
    "developed": "tone_mapped",
    "device_begins": "begins_on_device",
    "_everyone": "_global_count",
    "exchanging": "exchange_operation",
    "exchanging_all": "exchange_all_operation",
    "factoring": "factor_kernels",
    "fetched": "fetch",
    "filling": "fill_task",
    "_filling": "_fill_operation",
    "_found": "_release_counts",
    "found": "read",
    "_gathering": "_gather_kernel",
    "gathering": "field_gather",
    "go_on": "prepare_continuation",
    "_go_on": "_prepare_continuation",
    "handing_down": "restrict_to_coarse_kernel",
    "_has_run_ahead": "_take_device_step",
    "_hold_apart": "_cut_links_at_thin_solids",
    "is_ahead": "has_device_steps",
    "is_made_ahead": "is_made_on_gpu",
    "lacks": "is_missing_files",
    "_lacks": "_is_missing_files",
    "_last_words": "_report_abort",
    "led": "root_only",
    "_look": "_measure_material",
    "look": "measure_density",
    "look_again": "find_new_frames",
    "_look_again": "_add_new_frames",
    "look_around": "exchange_ghost_positions",
    "looked_on": "show_while_running",
    "measuring": "measure_kernel",
    "_meet": "_gather_outcomes",
    "meet": "boxes_overlap",
    "_most": "_largest_of_run",
    "_most_work": "_largest_work",
    "multiplying": "product_kernel",
    "noted": "record_event",
    "nudged": "perturb_diagonal",
    "of_one": "for_one_process",
    "rebuilding": "rebuild_program",
    "recall": "initial_impulses",
    "_refer": "_set_reference_residual",
    "remember": "store_positions",
    "removing": "register_removal",
    "renewing": "clear_kernel",
    "restricting": "restrict_kernel",
    "_said": "_with_reason",
    "seen_by": "cells_with_ghosts",
    "signing": "mark_changes_kernel",
    "smoothing": "smooth_kernels",
    "standing": "device_state",
    "sweeping": "sweep_kernel",
    "swing": "momentum_limit",
    "_take_in": "_store_received",
    "_tell": "_copy_to_kernels",
    "take": "launch, copy_part",
    "tell": "print_lines",
    "then": "queue_files",
    "_through": "_prefix_sums",
    "too_far": "displacement_beyond_ghosts",
    "transferring": "transfer_kernels",
    "trouble": "stop_reason",
    "_updating": "_update_kernel",
    "waits": "queue_stretch",
    "wrote": "add_file_sizes",
}
OLDER_MODULES = {
    "granular/solids.py": "wall_friction.py",
    "warp_lcp/default.py": "method_selection.py",
    "warp_lcp/distributed/solids.py": "subdomain_boundary.py",
    "warp_lcp/grid/part.py": "grid_part.py",
    "warp_lcp/grid/solids.py": "signed_distance.py",
    "warp_lcp/kernels/memory.py": "recorded_arguments.py",
    "warp_lcp/problem/protocol.py": "operator_protocol.py",
    "warp_lcp/problem/solve.py": "solve_loop.py",
    "warp_lcp/problem/spare_workspace.py": "workspace_cache.py",
    "warp_lcp/reduced/__init__.py": "subproblems/__init__.py",
}
# Words that tell nothing as the name of a class, alone or as its last word.
EMPTY_WORDS = {
    "Away",
    "Beginning",
    "Blurred",
    "Drawn",
    "Doubled",
    "Found",
    "Given",
    "Gone",
    "Growing",
    "Heard",
    "Held",
    "Joined",
    "Kept",
    "Least",
    "Look",
    "Looks",
    "Made",
    "Marked",
    "Misses",
    "Moved",
    "Moves",
    "Moving",
    "Own",
    "Other",
    "Others",
    "Parts",
    "Place",
    "Placed",
    "Places",
    "Plain",
    "Planned",
    "Plants",
    "Recorded",
    "Refuses",
    "Said",
    "Shared",
    "Show",
    "Shown",
    "Small",
    "Spare",
    "Taken",
    "Timed",
    "Told",
    "Touching",
    "Watched",
}
# Verbs in the third person; a capability is named `Has` with its noun.
VERBS = re.compile(
    r"(Applies|Converts|Gathers|Holds|Keeps|Makes|Masks|Multiplies|Names|Relaxes|Replicates|Starts"
    r"|Stores|Takes)(?=[A-Z]|$)"
)


# What no message, help text or description of a key says, besides those.
NOT_IN_MESSAGES = {
    **REPLACED,
    r"\bgoes? without\b": "cannot be combined with",
    r"\bwithout (far ends|an end)\b": "unbounded, periodic",
    r"\bsee to it\b": "make sure",
    r"\bnobody\b": "none, off",
    r"\banew\b": "again",
    r"\bunless given\b": "Default:",
}
# A module of kernels; names with a deprecation.
for old_name in (r"\bcrowding\b", r"\bangle_of\b", r"\bConvexSetProblem\b"):
    del NOT_IN_MESSAGES[old_name]


def documented() -> dict[str, str]:
    """Return the summary line of everything in docs/api, `run` and `scene`.

    It covers modules, classes and functions.
    """
    found: dict[str, str] = {}
    for reference in re.findall(
        r"^::: (\S+)",
        "\n".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md")),
        re.MULTILINE,
    ):
        parts = reference.split(".")
        places = [ROOT.joinpath(*parts[:n]) for n in range(len(parts), 0, -1)]
        file = next(
            file
            for place in places
            for file in (place.with_suffix(".py"), place / "__init__.py")
            if file.is_file()
        )
        node: ast.AST = parsed(file)
        for part in parts[len(file.relative_to(ROOT).with_suffix("").parts) :]:
            node = next(
                inner for inner in ast.iter_child_nodes(node) if getattr(inner, "name", "") == part
            )
        _add_summaries(found, reference, node)
    for file in (
        file for package in ("run", "scene") for file in (ROOT / "warp_lcp" / package).glob("*.py")
    ):
        _add_summaries(found, f"{file.parent.name}.{file.stem}", parsed(file))
    return found


def _add_summaries(found: dict[str, str], name: str, node: ast.AST) -> None:
    if name not in found and not any(
        "kernel" in word or "wp." in word
        for word in map(ast.unparse, getattr(node, "decorator_list", []))
    ):
        # A setter comes second; the text of a kernel is part of its module's hash.
        found[name] = (ast.get_docstring(node, clean=False) or "").split("\n")[0]  # type: ignore[arg-type]
    if isinstance(node, ast.ClassDef | ast.Module):
        for inner in node.body:
            if isinstance(inner, ast.ClassDef | ast.FunctionDef) and not inner.name.startswith("_"):
                _add_summaries(found, f"{name}.{inner.name}", inner)


def messages(phrases: re.Pattern[str]) -> Iterator[str]:
    """Yield place and text of each string with one of the phrases.

    Docstrings are left out.
    """
    for file in (
        file
        for package in ("warp_lcp", "fluids", "granular")
        for file in (ROOT / package).rglob("*.py")
    ):
        if not phrases.search(file.read_text()):
            continue  # most files need not be parsed
        docstrings = {
            id(node.value) for node in ast.walk(parsed(file)) if isinstance(node, ast.Expr)
        }
        for node in ast.walk(parsed(file)):
            if (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and id(node) not in docstrings
            ):
                if " " in node.value and phrases.search(node.value):
                    yield f"{file.relative_to(ROOT)}:{node.lineno}: {node.value}"


def public_summaries():
    """Return the summary line of each public name and of its public methods."""
    found = {}
    for module in (wl, gallery):
        for name in module.__all__:
            member = getattr(module, name)
            if (
                inspect.isclass(member) or inspect.isfunction(member)
            ) and member.__module__.startswith("warp_lcp"):
                found[name] = inspect.getdoc(member)
                for key, value in vars(member).items() if inspect.isclass(member) else ():
                    function = (
                        value.fget
                        if isinstance(value, property)
                        else getattr(value, "__func__", value)
                    )
                    if not key.startswith("_") and inspect.isfunction(function):
                        found[f"{name}.{key}"] = function.__doc__
    return {name: (text or "").strip().split("\n")[0] for name, text in found.items()}


def is_plain(summary: str) -> bool:
    """Return whether a summary line is short and begins with a noun or a verb."""
    words = summary.lower().split(" ")
    return (
        0 < len(summary) <= LONGEST
        and words[0] not in RIDDLES
        and words[:2] != ["return", "what"]
        and words[:2] != ["return", "how"]
    )


def test_summary_lines_name_the_thing():
    summaries = public_summaries() | documented()
    assert len(summaries) > 1000
    assert not [name for name, line in summaries.items() if not is_plain(line)]
    assert not is_plain("What a file lacks.")
    assert not is_plain("Return what a file lacks.")


def test_help_texts_are_short_and_name_the_thing():
    command = typer.main.get_command(app)
    found = {"": command.help} | {name: inner.help for name, inner in command.commands.items()}
    found |= {
        f"{name} {option.name}": option.help
        for name, inner in command.commands.items()
        for option in inner.params
    }
    found = {name: (text or "").strip() for name, text in found.items() if name != "bench suite"}
    assert len(found) > 60
    assert not [
        name
        for name, text in found.items()
        if not 0 < len(text) <= 115 or text.split(" ")[0].lower() in RIDDLES
    ]


def test_messages_have_no_replaced_phrases():
    assert not list(messages(re.compile("|".join(NOT_IN_MESSAGES), re.IGNORECASE)))
    assert next(messages(re.compile("no such device")))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_have_no_replaced_phrases(page):
    text = re.sub(r"\s+", " ", page.read_text())
    found = {
        match.group(): plain
        for phrase, plain in REPLACED.items()
        for match in re.finditer(phrase, text, re.IGNORECASE)
    }
    assert not found, f"write instead: {found}"


def glossary() -> list[tuple[str, str, str]]:
    """Return term, file and name of each entry; the name is empty for a whole file."""
    page = (ROOT / "docs" / "glossary.md").read_text()
    return re.findall(r"^\| ([^|]+) \| [^|]+ \| `([^`]+)`(?: `(\w+)`)? \|$", page, re.MULTILINE)


def test_the_glossary_is_in_order():
    terms = [term.lower() for term, _, _ in glossary()]
    page = (ROOT / "docs" / "glossary.md").read_text()
    assert len(terms) == page.count("\n| ") - 1 > 120  # every row but the heading was read
    assert terms == sorted(set(terms))


@pytest.mark.parametrize(("term", "file", "name"), glossary(), ids=lambda value: value)
def test_the_glossary_names_code_that_exists(term, file, name):
    assert (ROOT / file).is_file(), term
    defined = {
        getattr(node, "name", None) or getattr(target, "id", None)
        for node in parsed(ROOT / file).body
        for target in (getattr(node, "targets", None) or [None])
    }
    assert not name or name in defined, term


def places_of(
    defined: Callable[[Path], Iterable[tuple[str, int]]], *folders: str
) -> dict[str, str]:
    """Return the place of each class or function, nested ones included, by its name."""
    return {
        name: f"{file.relative_to(ROOT)}:{line}"
        for folder in folders
        for file in (ROOT / folder).rglob("*.py")
        for name, line in defined(file)
    }


def is_term(name: str) -> bool:
    """Return whether a class name is no participle, adjective, verb or empty word."""
    bare = name.lstrip("_")
    words = re.findall(r"[A-Z]+(?=[A-Z][a-z])|[A-Z][a-z]+|[A-Z]+", bare)
    return (
        bare not in OLDER_CLASSES
        and not VERBS.match(bare)
        and not (words and words[-1] in EMPTY_WORDS)
    )


def test_class_names_are_terms():
    places = places_of(classes, "warp_lcp", "fluids", "granular", "benchmarks", "tests", "docs")
    assert len(places) > 900
    assert {name: place for name, place in places.items() if not is_term(name)} == {}
    assert not any(map(is_term, ("Kept", "_Planned", "StoresRounded", "ReplacedTaken", "Told")))
    assert all(map(is_term, ("WorkspaceCache", "HasSweep", "GMRES", "StepFailed")))


def test_older_names_of_functions_do_not_come_back():
    places = places_of(functions, "warp_lcp", "fluids", "granular")
    found = {
        f"{name} ({places[name]})": OLDER_FUNCTIONS[name]
        for name in OLDER_FUNCTIONS.keys() & places.keys()
    }
    assert not found, f"write instead: {found}"


def test_older_names_of_modules_do_not_come_back():
    assert [name for name in OLDER_MODULES if (ROOT / name).exists()] == []
