"""Documentation as a whole, without a network and without MkDocs.

Links, anchors, names, citations, generated pages.
"""

import importlib
import importlib.util
import itertools
import re
import tomllib
from pathlib import Path

import pytest
import typer

import warp_lcp as wl
from code_blocks import anchors, links, prose
from warp_lcp import distributed, gallery
from warp_lcp.scene.scene_file import built_in_scenes, load_scene

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [
    *sorted(DOCS.rglob("*.md")),
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
]
SITE = (ROOT / "mkdocs.yml").read_text()
NAMED = re.findall(
    r"^::: ([\w.]+)$",
    "\n".join(page.read_text() for page in (DOCS / "api").glob("*.md")),
    flags=re.M,
)


def relative(page):
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_and_anchors_lead_somewhere(page):
    for link in links(page):
        if re.match(r"(https?|mailto):", link):
            continue
        target, _, anchor = link.partition("#")
        assert not target.startswith("/"), link
        file = (page.parent / target).resolve() if target else page
        assert file.exists(), f"{link}: there is no {target}"
        assert file.is_relative_to(ROOT), link
        if anchor:
            assert anchor in anchors(file), f"{link}: {file.name} has no such heading"


def test_the_link_test_detects_wrong_links(tmp_path):
    """Link test on wrong links.

    Headings and links in code are ignored, and repeated headings are counted.
    """
    page = tmp_path / "page.md"
    page.write_text(
        "# A `b` c: d\n\n```sh\n# no heading\n[x](y)\n```\n\n## Same\n\n## "
        "Same\n\n[in](other.md#a) and `[not](this)`\n"
    )
    assert anchors(page) == {"a-b-c-d", "same", "same_1"}
    assert links(page) == ["other.md#a"]


def test_every_page_is_in_the_navigation():
    named = set(re.findall(r"[\w/.-]+\.md", SITE))
    assert {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} <= named
    for name in named - {f"{notebook.stem}.md" for notebook in DOCS.glob("*.ipynb")}:
        assert (DOCS / name).is_file() or (ROOT / name).is_file(), name


def test_the_page_of_the_command_line_has_every_command():
    from warp_lcp.cli.commands import app

    cells = re.findall(r"^\| (`.*?`) \| ", (DOCS / "command-line.md").read_text(), flags=re.M)
    assert {name for cell in cells for name in re.findall(r"`(\w+)", cell)} == set(
        typer.main.get_command(app).commands
    )


def test_a_value_passes_through_five_files_at_most_from_its_key_to_its_kernel():
    """Path of a value from its key to its kernel: at most five files.

    Each file of the path exists and has the names on the page.
    """
    page = (
        (DOCS / "architecture.md").read_text().partition("## Four walks\n")[2].partition("\n## ")[0]
    )
    walks = re.split(r"^\*\*", page, flags=re.M)[1:]
    assert len(walks) == 4
    for walk in walks:
        steps = re.split(r"^\d\. ", walk, flags=re.M)[1:]
        assert 3 <= len(steps) <= 5
        for step in steps:
            file, *names = re.findall(r"`([^`]+)`", step)
            assert "." in file.rpartition("/")[2]
            assert [name for name in names if "/" in name] == []
            text = (DOCS.parent / file).read_text()
            assert [name for name in names if name not in text] == [], file


PLACES = re.findall(
    r"^\| ([^|]+) \| `([^`|]+)` \| ([^|]+) \|$",
    (DOCS / "architecture.md").read_text().partition("## Where is ...?\n")[2].partition("\n## ")[0],
    flags=re.M,
)


@pytest.mark.parametrize(("what", "file", "names"), PLACES, ids=[row[0] for row in PLACES])
def test_what_is_often_looked_for_is_where_the_page_says(what, file, names):
    """Table "Where is ...?": each name is defined in its file, and in no comment alone."""
    text = (ROOT / file).read_text()
    for name in re.findall(r"`([^`]+)`", names):
        short = re.escape(name.rpartition(" ")[2])
        defined = rf"^\s*(def|class) {short}\b|^{short}\b.* =|^// (kernel|snippet) (\S+\.)?{short}:"
        assert re.search(defined, text, flags=re.M), f"{file} does not define {name}"


# Terms of the field, each with files that name it in a summary line, where a search finds it.
TERMS = {
    "halo exchange": ["warp_lcp/distributed/halo.py", "warp_lcp/grid/grid_part.py"],
    "CFL": ["warp_lcp/run/stepping.py", "warp_lcp/material/particle_simulation.py"],
    "natural residual": ["warp_lcp/problem/residual.py", "warp_lcp/problem/headers/problem.h"],
    "truncated": ["warp_lcp/subproblems/multigrid_workspace.py"],
    "friction cone": ["granular/headers/sand.h", "granular/stress_layout.py"],
    "P2G": ["warp_lcp/grid/transfer.py", "warp_lcp/material/particle_simulation.py"],
    "checkpoint format": ["warp_lcp/run/checkpoint.py"],
    "default method": ["warp_lcp/method_rules.py"],
}


@pytest.mark.parametrize("term", TERMS)
def test_searches_for_terms_of_the_field_find_their_places(term):
    assert len(PLACES) >= 20
    for file in TERMS[term]:
        text = (ROOT / file).read_text()
        summaries = re.findall(r'"""(.*)$|^// (?:kernel|snippet) (.*)$', text, flags=re.M)
        lines = " ".join(filter(None, itertools.chain.from_iterable(summaries)))
        assert term.lower() in lines.lower(), f"{file} does not name {term} in a summary"


def test_the_architecture_page_lists_every_package_in_order():
    page, picture = ((DOCS / name).read_text() for name in ("architecture.md", "architecture.svg"))
    table = dict(re.findall(r"^\| `(?:warp_lcp/)?(\w+)(?:\.py)?` \| (.*?) \|", page, flags=re.M))
    assert {room for room in table if f">{room}</text>" not in picture} == {"benchmarks"}
    assert {path.parent.name for path in (ROOT / "warp_lcp").glob("*/__init__.py")} <= table.keys()
    for room, first in table.items():
        for file in re.findall(r"`(\w+\.py)`", first):
            places = [f"warp_lcp/{room}/{file}", f"{room}/{file}", f"warp_lcp/{file}"]
            assert any((ROOT / place).is_file() for place in places), (room, file)
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ][0]["layers"]
    layer = {
        name.strip().removeprefix("warp_lcp."): place
        for place, names in enumerate(contract)
        for name in names.split("|")
    }
    places = [layer[room] for room in table if room in layer]
    assert places == sorted(places)


def test_the_search_works_from_the_disk():
    """Search from the disk.

    The plug-in `offline` puts the index into a script, but loads another from the network, for
    browsers that allow no workers there.
    """
    assert re.search(r"^  - search\n  - offline\b", SITE, flags=re.M)
    spec = importlib.util.spec_from_file_location("site_pages", DOCS / "generate" / "site_pages.py")
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    page = f'<script src="{pages.SHIM}"></script>'
    assert pages.own_shim(page, "index.html") == '<script src="iframe-worker.js"></script>'
    assert (
        pages.own_shim(page, "benchmarks/results/peers.html")
        == '<script src="../../iframe-worker.js"></script>'
    )
    shim = (DOCS / pages.OWN_SHIM).read_text()
    assert "Permission is hereby granted" in shim
    assert 'location.protocol==="file:"&&(window.Worker=' in shim


def test_commands_of_pages_take_their_scenes_with_what_they_set():
    """Commands of pages with their scenes and settings.

    A resolution that does not divide a domain's sides was refused.
    """
    tried = 0
    for page in PAGES:
        for line in re.findall(
            r"^(?:\.venv/bin/)?warp-lcp (?:run|check|tune) (.*)", page.read_text(), flags=re.M
        ):
            words = line.partition("#")[0].split()
            if words[0] in built_in_scenes():
                load_scene(
                    words[0],
                    [
                        word.strip("'\"")
                        for flag, word in itertools.pairwise(words)
                        if flag == "--set"
                    ],
                )
                tried += 1
    assert tried > 10


def test_pages_name_no_place_of_a_machine():
    texts = [
        *(page.read_text() for page in PAGES),
        SITE,
        *(notebook.read_text() for notebook in DOCS.glob("*.ipynb")),
    ]
    for text in texts:
        assert not re.search(r"(?<![\w.])/(home|root|work|tmp|Users)/", text)


@pytest.mark.parametrize("name", NAMED)
def test_the_reference_names_what_exists(name):
    module, _, attribute = name.rpartition(".")
    if importlib.util.find_spec(name.split(".")[0]) and attribute and attribute[0].islower():
        try:
            found = importlib.import_module(name)
        except ModuleNotFoundError:
            found = getattr(importlib.import_module(module), attribute)
    else:
        found = getattr(importlib.import_module(module), attribute)
    assert found.__doc__


def test_the_reference_has_every_public_name():
    short = {name.rpartition(".")[2] for name in NAMED}
    constants = {"AIR", "FLUID", "SOLID", "METHODS", "Precision", "Step"}
    assert set(wl.__all__) - constants <= short
    assert set(distributed.__all__) <= short
    assert {
        f"warp_lcp.gallery.{path.stem}" for path in Path(gallery.__file__).parent.glob("[a-z]*.py")
    } <= set(NAMED)


@pytest.mark.parametrize(
    "name",
    ["scene_keys", "method_settings", "device_figures", "published_figures", "choice_figures"],
)
def test_generated_pages_are_up_to_date(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / "generate" / f"{name}.py")
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    assert generator.PAGE.read_text() == generator.page(), f"run: python docs/generate/{name}.py"


def test_the_page_of_scene_files_has_every_key():
    """Every key on the page of scene files, from the schemas themselves.

    The generator is not used.
    """
    from warp_lcp.scene.scene_file import installed_simulators

    text = (DOCS / "scenes.md").read_text()
    for simulator in installed_simulators().values():
        schema = simulator.scene_model.model_json_schema(by_alias=True)
        keys = {
            key for definition in schema["$defs"].values() for key in definition["properties"]
        } - {"kind", "shape", "reseed", "narrow_band"}
        assert {key for key in keys if f"| `{key}` |" not in text} == set()
        assert all(f"[{table}]" in text for table in schema["properties"])


CITATION = re.compile(r"([A-Z][a-z]+(?:-[A-Z][a-z]+)*)(?: et al\.)?,? \(?((?:19|20)\d\d)\b")
NOT_NAMES = {"Since", "In", "From", "November", "Claypool"}


def test_every_citation_is_in_the_bibliography():
    entries = re.split(r"\n\n|\n- ", prose(DOCS / "bibliography.md"))
    sources = [
        path
        for package in ("warp_lcp", "fluids", "granular", "benchmarks")
        for path in (ROOT / package).rglob("*.py")
    ]
    cited = {match for path in [*sources, *PAGES] for match in CITATION.findall(path.read_text())}
    cited = {(name, year) for name, year in cited if name not in NOT_NAMES and int(year) < 2026}
    assert ("Rockafellar", "1976") in cited
    missing = {
        (name, year)
        for name, year in cited
        if not any(name in entry and f"{year}" in entry for entry in entries)
    }
    assert missing == set()
