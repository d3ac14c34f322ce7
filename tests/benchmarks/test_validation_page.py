"""The page of the suite `validation`: it needs nothing else, says what was found, and a browser shows all of it."""

import json
import math
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.image import imread

from warp_lcp import benchmarks
from warp_lcp.benchmarks import svg
from warp_lcp.benchmarks.record import Lines, Record
from warp_lcp.benchmarks.validation import CHECKS, KNOWN
from warp_lcp.benchmarks.validation.finding import Findings, Trial, attempt
from warp_lcp.benchmarks.validation.html_page import Section, page
from warp_lcp.simulation import StepFailed

MACHINE = Record(
    "machine", {}, {"date": "2030-01-02 03:04 UTC", "hardware": {"cpu": "Z80", "device": "cpu"}, "versions": {"warp-lang": "9"}}
)
SVG = "{http://www.w3.org/2000/svg}"
VOID = {"meta", "link", "br", "hr", "img", "input"}
KEPT = sorted(Path(benchmarks.__file__).parent.glob("results/*/validation-report.html"))
BROWSER = next((found for name in ("chromium", "chromium-browser", "google-chrome", "chrome") if (found := shutil.which(name))), None)
WIDTH = 1000
# in a copy of a page, for a browser to tell where it put the plots
LOOK = """<script>
const box = (e) => { const b = e.getBoundingClientRect(); return [b.left + scrollX, b.top + scrollY, b.width, b.height]; };
const charts = [...document.querySelectorAll("svg.chart")].map((s) => ({box: box(s), shown: s.checkVisibility(),
  curves: [...s.querySelectorAll("polyline")].map((c) => ({box: box(c), color: getComputedStyle(c).stroke}))}));
document.body.setAttribute("data-found", JSON.stringify({height: document.documentElement.scrollHeight,
  width: document.documentElement.scrollWidth, charts}));
</script>"""


def trial(value: float = 0.5, broken: float = 2.0, resolution: str = "8 cells") -> Trial:
    def run(found: Findings) -> None:
        found.add("error <of the period>", value, high=1.0, unit="%")
        found.must_break("whole cells & stairs: error", broken, high=1.0, unit="%")

    return attempt("waves", resolution, run)


def chart() -> Lines:
    t = np.linspace(0.0, 9.0, 20_000)
    curves = {"theory": (t.tolist(), np.cos(t).tolist()), "8 cells": (t.tolist(), np.cos(1.02 * t).tolist()), "data": ([1, 2], [0.5, -0.5])}
    return Lines("waves", "Waves", "t [s]", "a < b", curves, logarithmic_x=False, logarithmic_y=False, marked=frozenset({"data"}))


def steep() -> Lines:
    return Lines("orders", "Orders", "n", "error", {"a": ([1, 10, 100, 1000], [1.0, 1e-3, 0.0, 1e-9]), "nothing": ([1.0], [math.nan])})


def example(*trials: Trial, known: str = "") -> str:
    sections = [Section("waves", "Waves on water.", trials or (trial(),), [chart(), steep()], known)]
    return page("Known answers", MACHINE, sections)


class Reader(HTMLParser):
    """Collects what a page refers to, and sees that its elements are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open, self.names, self.tags, self.words = [], set(), [], []
        self.references = []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        for name, value in attributes:
            if name in ("href", "src", "srcset", "data", "action", "xlink:href"):
                self.references.append(value)
            if name == "id":
                assert value not in self.names
                self.names.add(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def read(text: str) -> Reader:
    reader = Reader()
    reader.feed(text)
    assert reader.open == []
    return reader


PAGES = [pytest.param(example(), id="example"), *(pytest.param(path.read_text(encoding="utf-8"), id=path.parent.name) for path in KEPT)]


@pytest.mark.parametrize("text", PAGES)
def test_a_page_needs_nothing_else(text):
    reader = read(text)
    for reference in reader.references:
        assert reference == "data:," or (reference.startswith("#") and reference[1:] in reader.names)
    assert not {"script", "img", "iframe", "object", "embed"} & set(reader.tags)
    assert not re.search(r"url\(|@import", text)
    assert text.count("http") == text.count('xmlns="http://www.w3.org/2000/svg"')  # a name, which nothing fetches
    assert len(text.encode()) < 1_000_000


def test_the_site_has_no_other_page_of_that_name():
    """MkDocs makes NAME.html of NAME.md, in place of a page that is called so."""
    assert not [path for path in KEPT if path.with_suffix(".md").exists()]


def test_a_page_says_what_was_found():
    text = " ".join(" ".join(read(example(known="ripples")).words).split())
    assert "1 of 1 figures keep their tolerance, and 1 of 1 negative controls fail theirs, as they must" in text
    for part in ("2030-01-02 03:04 UTC", "cpu Z80, device cpu", "warp-lang 9", "Waves on water.", "waves, 8 cells"):
        assert part in text
    assert "error <of the period> 0.5 % <= 1 % \u2713 keeps it" in text
    assert "control: whole cells & stairs: error 2 % must break <= 1 % \u2713 breaks it, as it must" in text
    assert "ripples" not in text  # a reason for what holds
    assert "Not as it must be" not in text


def test_a_page_says_what_does_not_hold():
    def ends(found: Findings) -> None:
        found.add("speed", math.nan, high=1.0)
        raise StepFailed("no <convergence>")

    text = " ".join(" ".join(read(example(trial(1.5, 0.5), attempt("waves", "9 cells", ends), known="ripples")).words).split())
    assert "0 of 2 figures keep their tolerance, and 0 of 1 negative controls" in text
    assert "error <of the period> 1.5 % <= 1 % \u2717 FAILS" in text
    assert "error 0.5 % must break <= 1 % \u2717 does NOT break it" in text
    assert "speed not measured <= 1 \u2717 FAILS" in text
    assert "ended early: no <convergence>" in text
    assert "Known: ripples." in text
    assert "Not as it must be: waves, 8 cells: error <of the period> = 1.5 % (<= 1 %)" in text


def test_reasons_are_of_checks():
    assert KNOWN.keys() <= CHECKS.keys()
    assert all(module.__doc__ for module in CHECKS.values())


def numbers(element: ElementTree.Element) -> np.ndarray:
    return np.array([[float(v) for v in point.split(",")] for point in element.get("points").split()])


def test_a_curve_is_where_its_axes_say():
    """Read back with the ticks, a drawn curve is the curve."""
    line = Lines("l", "l", "x", "y", {"c": ([0.0, 5.0, 10.0], [-1.0, 3.0, 1.0])}, logarithmic_x=False, logarithmic_y=False)
    drawn = ElementTree.fromstring(svg.draw(line))
    points = numbers(drawn.find(f"{SVG}polyline"))
    texts = [(float(t.get("x")), float(t.get("y")), t.get("text-anchor"), t.text) for t in drawn.iter(f"{SVG}text") if t.get("x")]
    along = [(x, float(t)) for x, y, anchor, t in texts if anchor == "middle" and re.fullmatch(r"-?[\d.]+", t)]
    up = [(y - 4.0, float(t)) for x, y, anchor, t in texts if anchor == "end"]
    for axis, ticks, values in ((0, along, [0.0, 5.0, 10.0]), (1, up, [-1.0, 3.0, 1.0])):
        places, marks = np.array(ticks).T
        slope, offset = np.polyfit(places, marks, 1)
        assert slope * points[:, axis] + offset == pytest.approx(values, abs=0.02)
    assert points[1, 1] < points[2, 1] < points[0, 1]  # larger is higher


def test_logarithmic_axes_leave_out_what_they_cannot_show():
    drawn = ElementTree.fromstring(svg.draw(steep()))
    (curve,) = drawn.findall(f"{SVG}polyline")
    points = numbers(curve)
    assert len(points) == 3
    steps = np.diff(points, axis=0)
    assert steps[1, 0] == pytest.approx(2.0 * steps[0, 0], abs=0.2)  # from 1 to 10, and from 10 to 1000
    assert steps[1, 1] == pytest.approx(2.0 * steps[0, 1], abs=0.2)  # from 1 to 1e-3, and to 1e-9
    assert "nothing" not in " ".join(drawn.itertext())


def test_a_thinned_curve_keeps_its_peaks():
    x = np.linspace(66.0, 626.0, 40_000)
    y = 100.0 + np.sin(40.0 * x)
    y[[123, 20_000, 39_998]] = 300.0, 5.0, 301.0
    kept = svg.thinned(np.column_stack([x, y]))
    assert len(kept) < 1000
    assert {300.0, 5.0, 301.0} <= set(kept[:, 1])
    assert (np.diff(kept[:, 0]) > 0).all()
    assert kept[[0, -1], 0] == pytest.approx([66.0, 626.0])
    circle = np.column_stack([np.cos(x), np.sin(x)])
    assert svg.thinned(circle) is circle


@pytest.mark.parametrize(
    "chart", [chart(), steep(), Lines("e", "empty", "x", "y", {"c": ([], [])}), Lines("o", "one", "x", "y", {"c": ([3], [7])})]
)
def test_charts_stay_within_their_drawing(chart):
    drawn = ElementTree.fromstring(svg.draw(chart))
    _, _, width, height = (float(v) for v in drawn.get("viewBox").split())
    for element in drawn.iter():
        for horizontal, vertical in (("x", "y"), ("cx", "cy")):
            if element.get(horizontal) is not None:
                assert 0.0 <= float(element.get(horizontal)) <= width
                assert 0.0 <= float(element.get(vertical)) <= height
        if element.tag == f"{SVG}polyline":
            assert (numbers(element) >= 0.0).all()
            assert (numbers(element) <= [width, height]).all()


def browse(folder: Path, text: str, *options: str) -> tuple[str, list[str]]:
    """Show a page in a browser of its own; return what it wrote and what its console said."""
    file = folder / "page.html"
    file.write_text(text, encoding="utf-8")
    quiet = ("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic")
    shown = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--force-device-scale-factor=1", "--enable-logging=stderr")
    offline = ("--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={folder / 'profile'}")
    ran = subprocess.run(
        [BROWSER, *shown, *quiet, *offline, *options, file.as_uri()], capture_output=True, text=True, check=True, timeout=300
    )  # fmt: skip
    return ran.stdout, [line for line in ran.stderr.splitlines() if "CONSOLE" in line]


def found_in(text: str) -> dict:
    return json.loads(re.search(r"data-found='([^']*)'|data-found=\"([^\"]*)\"", text).group(2).replace("&quot;", '"'))


needs_browser = pytest.mark.skipif(BROWSER is None, reason="there is no Chromium (Debian: apt-get install chromium)")


@needs_browser
def test_the_browser_tells_errors_and_hidden_plots(tmp_path):
    """What the next test relies on."""
    wrong = example().replace("</body>", "<script>undefined_name.x;</script></body>")
    _, errors = browse(tmp_path, wrong, "--dump-dom")
    assert any("undefined_name is not defined" in line for line in errors)
    hidden = example().replace("<figure>", '<figure style="display: none">', 1)
    text, _ = browse(tmp_path, hidden.replace("</body>", LOOK + "</body>"), "--dump-dom")
    assert [chart["shown"] for chart in found_in(text)["charts"]] == [False, True]


@needs_browser
@pytest.mark.parametrize("text", PAGES)
def test_a_browser_shows_every_plot(tmp_path, text):
    window = f"--window-size={WIDTH},800"
    told, errors = browse(tmp_path, text.replace("</body>", LOOK + "</body>"), window, "--dump-dom")
    assert errors == []
    found = found_in(told)
    assert found["width"] <= WIDTH  # nothing to scroll to the side for
    assert len(found["charts"]) == text.count("<svg") > 1
    picture = tmp_path / "page.png"
    _, errors = browse(tmp_path, text, f"--window-size={WIDTH},{found['height'] + 200}", f"--screenshot={picture}")
    assert errors == []
    pixels = np.round(255.0 * imread(picture)[..., :3]).astype(int)
    for chart in found["charts"]:
        assert chart["shown"]
        assert min(chart["box"][2:]) > 200.0
        left, top, width, height = (round(v) for v in chart["box"])
        inside = pixels[top : top + height, left : left + width].reshape(-1, 3)
        for curve in chart["curves"]:
            color = [int(v) for v in re.findall(r"\d+", curve["color"])[:3]]
            near = (np.abs(inside - color) <= 40).all(axis=1)  # a thin line's edges are blended with what is behind
            assert near.sum() > 20, (chart, curve)


@needs_browser
def test_a_page_prints(tmp_path):
    text = example(*(trial(resolution=f"{n} cells") for n in range(40)))
    browse(tmp_path, text, f"--print-to-pdf={tmp_path / 'page.pdf'}", "--no-pdf-header-footer")
    printed = (tmp_path / "page.pdf").read_bytes()
    assert printed.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) >= 2
