"""Draw mutants, run the tests of each and report the survivors.

Run `python -m warp_lcp.benchmarks.mutants --count 50 --seed 7`.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from warp_lcp.benchmarks.mutants.formulas import FORMULAS
from warp_lcp.benchmarks.mutants.mutations import FORMULA, Mutant, draw, mutated, of_formulas
from warp_lcp.benchmarks.mutants.tests_of import tests_of

if TYPE_CHECKING:
    import pytest

ROOT = Path(__file__).resolve().parents[2]
HANGS = 40  # CPU seconds that no single test exceeds
PYTEST = ["-x", "-q", "--no-header", "-p", "no:cacheprovider", "--hypothesis-seed=7"]
# Numbers of test files: the first run with one parameter of each function, then, for a survivor,
# the second with all.
FILES = (1, 4)
# Imported before the forks. Warp is not initialized: there are no threads and no device.
PRELOADED = ("pyamg", "pydantic", "pytest", "rich", "scipy.sparse.linalg", "typer", "warp")
TREE: Path
SECONDS = 5.0
SOUND: set[str] = set()  # tests that pass without a change, and those that fail
BROKEN: set[str] = set()


def prepare(folder: str, files: tuple[int, int] = FILES, seconds: float = 60.0) -> None:
    """Copy the tree for one worker and import the modules that no mutant changes.

    Forks then start with them.
    """
    global TREE, FILES, SECONDS  # each worker has its own
    TREE, FILES, SECONDS = Path(tempfile.mkdtemp(dir=folder)), files, seconds
    ignore = shutil.ignore_patterns(
        ".git", ".venv*", "out", "build", "results", ".*_cache", ".hypothesis"
    )
    # The links stay links: `warp_lcp/fluids` is the folder `fluids` that a mutant changes.
    shutil.copytree(ROOT, TREE, symlinks=True, ignore=ignore, dirs_exist_ok=True)
    for name in PRELOADED:
        importlib.import_module(name)


class MutantBudget:
    """Plug-in of pytest with a time budget for each file.

    Tests that start after its end are left out. The compilation of changed kernels does not count.
    On request, each function runs with one parameter only.
    """

    def __init__(self, seconds: float, *, brief: bool) -> None:
        self.seconds, self.brief, self.began, self.compiled = seconds, brief, 0.0, 0.0
        self.spent: defaultdict[str, float] = defaultdict(float)

    def pytest_configure(self) -> None:
        """Record the time in which Warp loads modules."""
        import warp as wp

        load = wp.Module.load

        def timed_load(*arguments: Any, **options: Any) -> Any:
            began = time.process_time()
            try:
                return load(*arguments, **options)
            finally:
                self.compiled += time.process_time() - began

        wp.Module.load = timed_load

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep the first parameter of each function that runs by default."""
        if self.brief:
            default = [item for item in items if not item.get_closest_marker("slow")]
            items[:] = {item.nodeid.split("[")[0]: item for item in reversed(default)}.values()
            items.reverse()

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Skip a test that starts too late."""
        import pytest

        if self.spent[str(item.path)] > self.seconds:
            pytest.skip("no time left for this file")

    def pytest_runtest_logstart(self) -> None:
        """Record the time."""
        self.began, self.compiled = time.process_time(), 0.0

    def pytest_runtest_logfinish(self, location: tuple[str, int, str]) -> None:
        """Add the time of a test to that of its file."""
        passed = time.process_time() - self.began
        self.spent[str(TREE / location[0])] += passed - self.compiled


def tests(arguments: list[str], *, brief: bool = False) -> tuple[str, str, float]:
    """Run pytest on this worker's tree in a process of its own.

    Args:
        arguments: arguments of pytest.
        brief: whether to run each test with one of its parameters.

    Returns:
        "passed", "failed", "crashed" or "timeout", the end of its output, and its CPU time [s].
    """
    log, limit = TREE / "mutant.log", int(SECONDS * len(arguments) + HANGS)
    child = os.fork()
    if child == 0:
        _become_pytest(arguments, MutantBudget(SECONDS, brief=brief), limit, log)
    deadline = time.monotonic() + 8 * limit
    while not (found := os.wait4(child, os.WNOHANG))[0]:
        if time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.05)
    _, status, usage = found
    ended_by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    verdict = {0: "failed", signal.SIGKILL: "timeout", signal.SIGXCPU: "timeout"}.get(
        ended_by, "crashed"
    )
    return (
        verdict if status else "passed",
        log.read_text(errors="replace")[-20000:],
        usage.ru_utime + usage.ru_stime,
    )


def _become_pytest(arguments: list[str], budget: MutantBudget, limit: int, log: Path) -> NoReturn:
    """Turn this fork into a run of pytest on the worker's tree."""
    os.setsid()
    os.chdir(TREE)
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
    os.dup2(1, 2)
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
    os.environ["PYTHONPATH"] = str(TREE)
    sys.path[:] = [str(TREE), *(p for p in sys.path if Path(p or ".").resolve() != ROOT)]
    # This program is part of the package, so its modules are removed too.
    for name in [name for name in sys.modules if name.split(".")[0] == "warp_lcp"]:
        del sys.modules[name]
    gc.collect()  # frees their kernels, which Warp otherwise keeps registered
    import pytest

    status: int = pytest.ExitCode.INTERNAL_ERROR
    try:
        status = pytest.main([*PYTEST, *arguments], plugins=[budget])
    except BaseException:  # anything that a mutant raises
        traceback.print_exc(file=sys.stdout)
    finally:
        sys.stdout.flush()
        os._exit(status)


def judge(mutant: Mutant) -> dict[str, object]:
    """Apply a mutant, run its tests and revert it.

    Tests that fail without it too are left out from then on.
    """
    path = TREE / mutant.module
    source, stat = path.read_text(), path.stat()
    chosen_tests = (
        [FORMULAS[mutant.occurrence].tests]
        if mutant.operator == FORMULA
        else tests_of(TREE, mutant.module, mutant.line)
    )
    spent, verdict, by = 0.0, "alive", ""
    rounds = sorted(set(FILES))
    while rounds and verdict == "alive":
        path.write_text(mutated(source, mutant.operator, mutant.occurrence))
        outcome, text, took = tests(
            [*chosen_tests[: rounds[0]], *(f"--deselect={name}" for name in BROKEN)],
            brief=rounds[0] == FILES[0],
        )
        path.write_text(source)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        spent += took
        names = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - |$)", text, re.MULTILINE)
        if outcome == "failed" and names and "::" in names[0] and names[0] not in SOUND:
            (SOUND if tests(names[:1])[0] == "passed" else BROKEN).add(names[0])
        if names and names[0] in BROKEN:
            continue
        if outcome != "passed":
            verdict = (
                outcome
                if outcome == "timeout"
                else "killed"
                if names or outcome == "crashed" or "while loading conftest" in text
                else "broken test"
            )
            by = names[0] if names else text[-300:]
        number = rounds.pop(0)
    return {
        **mutant._asdict(),
        "verdict": verdict,
        "by": by,
        "tests": chosen_tests[:number],
        "seconds": round(spent, 1),
    }


def report(results: list[dict[str, object]], out: Path, seed: int) -> None:
    """Write mutants.json and mutants.md; print the latter, which names the survivors."""
    (out / "mutants.json").write_text(json.dumps(results, indent=1))
    counts = Counter(str(r["verdict"]) for r in results)
    seconds = sum(float(str(r["seconds"])) for r in results)
    lines = [
        f"# {len(results)} mutants of seed {seed}: "
        f"{', '.join(f'{n} {verdict}' for verdict, n in sorted(counts.items()))}"
    ]
    lines += [
        f"{seconds:.0f} s of processor time",
        "",
        "| where | before | after | verdict |",
        "|---|---|---|---|",
    ]
    left = [r for r in results if r["verdict"] != "killed"]
    lines += [
        f"| `{r['module']}:{r['line']}` | `{r['before']}` | `{r['after']}` | {r['verdict']} |"
        for r in left
    ]
    (out / "mutants.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m warp_lcp.benchmarks.mutants", description=__doc__
    )
    parser.add_argument(
        "--count", type=int, help="number of mutants; default: 50 over all modules, or all formulas"
    )
    parser.add_argument("--seed", type=int, default=7, help="seed of the random choice")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument(
        "--out",
        type=Path,
        default=ROOT / "out/mutants",
        help="folder of the report; of a run that was stopped: go on",
    )
    parser.add_argument(
        "--formulas",
        action="store_true",
        help="use the changes and tests of formulas.py instead of random ones",
    )
    parser.add_argument(
        "--again", type=Path, help="try the survivors of a mutants.json instead of new mutants"
    )
    parser.add_argument(
        "--files",
        type=int,
        nargs=2,
        default=FILES,
        help="numbers of test files: first try, and again if a mutant survives; equal: no second",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=5.0,
        help="processor time per test file [s]; tests that would start later are skipped",
    )
    return parser.parse_args()


def _drawn(formulas: bool, count: int | None, seed: int) -> list[Mutant]:
    """Return `count` mutants of a seed: of the formulas, or of all modules."""
    if not formulas:
        return draw(ROOT, 50 if count is None else count, seed)
    everyone = of_formulas(ROOT)
    return (
        everyone
        if count is None
        else random.Random(seed).sample(everyone, min(count, len(everyone)))
    )


def main() -> None:
    """Run the command line."""
    arguments = options()
    arguments.out.mkdir(parents=True, exist_ok=True)
    kernels, usual, results_file = (
        arguments.out.parent / "kernels-of-mutants",
        Path("~/.cache/warp").expanduser(),
        arguments.out / "mutants.json",
    )
    if usual.exists() and not kernels.exists():
        shutil.copytree(usual, kernels)
    os.environ["WARP_CACHE_PATH"] = str(kernels)
    if arguments.again:
        drawn = [
            Mutant(*(r[name] for name in Mutant._fields))
            for r in json.loads(arguments.again.read_text())
            if r["verdict"] != "killed"
        ]
    else:
        drawn = _drawn(arguments.formulas, arguments.count, arguments.seed)
    results = json.loads(results_file.read_text()) if results_file.exists() else []
    done = {tuple(r[name] for name in Mutant._fields[:4]) for r in results}
    todo = [mutant for mutant in drawn if mutant[:4] not in done]
    random.Random(arguments.seed).shuffle(
        todo
    )  # a run that is stopped has then covered all packages
    started = (
        arguments.jobs,
        prepare,
        (folder := tempfile.mkdtemp(), arguments.files, arguments.seconds),
    )
    with multiprocessing.get_context("fork").Pool(*started) as pool:
        for result in pool.imap_unordered(judge, todo):
            results.append(result)
            print("{verdict:8}{seconds:6} s {module}:{line} {after}".format(**result), flush=True)
            results_file.write_text(json.dumps(results, indent=1))
    shutil.rmtree(folder)
    report(results, arguments.out, arguments.seed)


if __name__ == "__main__":
    main()
