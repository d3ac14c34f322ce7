"""Mutants: valid code with one change each, drawn by seed from all packages.

Tests are chosen by the name of the changed code.
"""

import ast
from pathlib import Path

import pytest

from warp_lcp.benchmarks.mutants.formulas import FORMULAS
from warp_lcp.benchmarks.mutants.tests_of import _steps as steps_of
from warp_lcp.benchmarks.mutants.tests_of import _users as users_of
from warp_lcp.benchmarks.mutants.tests_of import tests_of as chosen_for

ROOT = Path(__file__).resolve().parents[2]


def test_tests_named_after_the_module_run_first():
    assert (
        chosen_for(ROOT, "warp_lcp/multigrid/hierarchy.py")[0]
        == "tests/multigrid/test_hierarchy.py"
    )
    assert (
        chosen_for(ROOT, "warp_lcp/material/sources_kernels.py")[0]
        == "tests/material/test_sources.py"
    )


def test_words_that_happen_to_be_the_same_choose_no_test():
    """Tests of a part of a grid: those that import it, not those of the same word elsewhere.

    `MODULE` is a constant of many modules, and a word of the tests of the log's filter.
    """
    module = "warp_lcp/grid/barrier_velocity_kernels.py"
    chosen = chosen_for(ROOT, module)
    assert chosen[0] == "tests/grid/test_barrier_faces.py"
    assert {Path(test).parent.name for test in chosen[:4]} == {"grid"}
    assert "tests/kernels/test_log_filter.py" not in chosen[:20]


def test_tests_import_modules_through_helpers_and_names_of_the_package(tmp_path):
    files = {
        "warp_lcp/__init__.py": "from warp_lcp.solvers.newton import Newton\n",
        "warp_lcp/solvers/newton.py": "from warp_lcp.steps import step\n",
        "warp_lcp/steps.py": "def step(): ...\n",
        "tests/problems.py": "import warp_lcp as wl\nwl.Newton\n",
        "tests/test_a.py": "from warp_lcp.steps import step\n",
        "tests/test_b.py": "from problems import case\n",
        "tests/test_c.py": "step = 1\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert steps_of(tmp_path, {"warp_lcp/steps.py"}) == {"tests/test_a.py": 0, "tests/test_b.py": 1}


def test_a_mutant_is_one_change_that_still_is_python():
    pytest.importorskip("cosmic_ray")
    from warp_lcp.benchmarks.mutants.mutations import draw, mutated

    drawn = draw(ROOT, 3, 5)
    assert drawn == draw(ROOT, 3, 5)
    assert len({mutant.module for mutant in drawn}) == 3
    for mutant in drawn:
        before = (ROOT / mutant.module).read_text()
        after = mutated(before, mutant.operator, mutant.occurrence)
        if mutant.module.endswith(".py"):
            ast.parse(after)
        pairs = list(zip(before.splitlines(), after.splitlines(), strict=False))
        assert (mutant.before, mutant.after) in [(a.strip(), b.strip()) for a, b in pairs if a != b]


def test_formulas_are_found_in_their_files():
    for formula in FORMULAS:
        assert (ROOT / formula.module).read_text().count(formula.before) == 1, formula
        assert formula.before != formula.after
        assert (ROOT / formula.tests).exists()
    assert len(FORMULAS) == len(set(FORMULAS)) >= 150


def test_mutants_of_formulas_are_one_change():
    pytest.importorskip("cosmic_ray")
    from warp_lcp.benchmarks.mutants.mutations import mutated, of_formulas

    for mutant, formula in zip(of_formulas(ROOT), FORMULAS, strict=True):
        source = (ROOT / mutant.module).read_text()
        assert formula.before.split("\n")[0].strip() in source.splitlines()[mutant.line - 1]
        assert (
            mutated(source, mutant.operator, mutant.occurrence)
            == source.replace(formula.before, formula.after)
            != source
        )


def test_headers_are_changed_between_operands_only():
    pytest.importorskip("cosmic_ray")
    from warp_lcp.benchmarks.mutants.mutations import mutated, native_places

    source = (
        "#if A && B\nconst float* x = (const float*)y + row;  // a < b\nif (*x < -1) { z = a*b; }\n"
    )
    swapped = {mutated(source, "NativeSwap", n) for n in range(len(native_places(source)))}
    assert swapped == {
        source.replace(*pair)
        for pair in [("y + row", "y - row"), ("x < -1", "x <= -1"), ("a*b", "a/b")]
    }


def test_headers_have_the_tests_of_modules_that_name_them():
    assert (
        "tests/multigrid/test_hierarchy.py"
        in chosen_for(ROOT, "warp_lcp/multigrid/headers/coarsen.h")[:4]
    )
    assert (
        "tests/kernels/test_persistent_kernel.py"
        in chosen_for(ROOT, "warp_lcp/kernels/headers/piece.h")[:4]
    )


def test_a_line_of_a_header_has_the_tests_of_the_module_that_names_its_kernel():
    header = "warp_lcp/solvers/headers/gradient_projection.h"
    lines = (ROOT / header).read_text().splitlines()
    for kernel, test in (("mprgp.", "test_mprgp"), ("subspace.", "test_subspace_minimization")):
        line = next(n for n, text in enumerate(lines, 1) if text.startswith(f"// kernel {kernel}"))
        assert f"tests/solvers/{test}" in chosen_for(ROOT, header, line)[0]


def test_modules_of_a_simulator_have_the_tests_of_their_users():
    users = users_of(ROOT)["fluids/viscosity_level.py"]
    assert users == {
        "fluids/stokes_bodies.py",
        "fluids/stokes_operator.py",
        "fluids/viscosity.py",
        "fluids/viscosity_bodies.py",
        "fluids/viscosity_multigrid.py",
    }


def test_a_mutant_of_a_simulator_is_in_the_package_that_tests_import(tmp_path, monkeypatch):
    pytest.importorskip("cosmic_ray")
    from warp_lcp.benchmarks.mutants import __main__ as program

    for name, value in {"ROOT": tmp_path / "root", "PRELOADED": (), "TREE": tmp_path}.items():
        monkeypatch.setattr(program, name, value, raising=False)
    (tmp_path / "root/fluids").mkdir(parents=True)
    (tmp_path / "root/warp_lcp").mkdir()
    (tmp_path / "root/fluids/a.py").write_text("1\n")
    (tmp_path / "root/warp_lcp/fluids").symlink_to("../fluids")
    program.prepare(str(tmp_path), program.FILES, program.SECONDS)
    (program.TREE / "fluids/a.py").write_text("2\n")
    assert (program.TREE / "warp_lcp/fluids/a.py").read_text() == "2\n"
    assert (tmp_path / "root/fluids/a.py").read_text() == "1\n"
