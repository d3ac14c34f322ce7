"""Figures, files, comparisons, targets."""

import json
from pathlib import Path

import pytest
import warp as wp

from warp_lcp import benchmarks
from warp_lcp.benchmarks.harness import machine, report
from warp_lcp.benchmarks.harness.compare import bounds, comparison
from warp_lcp.benchmarks.harness.machine import array_bytes, resident_bytes
from warp_lcp.benchmarks.harness.record import (
    Bars,
    BenchmarkRecord,
    RecordLines,
    RecordTable,
    RecordTarget,
    Results,
    read_json,
    write_json,
)
from warp_lcp.benchmarks.harness.timing import Figure, in_turns, ratios, timed


def record(name, *samples, **facts):
    return BenchmarkRecord(name, {"total": Figure.of(samples, "s")}, facts)


def test_figures():
    figure = Figure.of([3.0, 1.0, 2.0], "s")
    assert (figure.value, figure.low, figure.high, figure.samples) == (2.0, 1.0, 3.0, 3)
    assert Figure.from_dict(figure.as_dict()) == figure
    assert Figure.from_dict(Figure(7).as_dict()) == Figure(7)
    assert str(figure) == "2 s (1 to 3)"
    assert ratios([2.0, 6.0], [1.0, 2.0]).value == 2.5


def test_in_turns_takes_one_sample_of_each_a_round():
    order = []

    def work(name):
        def run():
            order.append(name)
            begin = 0
            for i in range(60_000):  # longer than the shortest sample
                begin += i

        return run

    times = in_turns({"a": work("a"), "b": work("b")}, 3)
    assert {name: len(taken) for name, taken in times.items()} == {"a": 3, "b": 3}
    assert order[-1] == "b"
    assert all(t > 0 for taken in times.values() for t in taken)


def test_files_keep_records(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, [record("one", 1.0, 2.0, n=64), record("two", 3.0)])
    kept = json.loads(path.read_text())
    assert [r["name"] for r in kept] == ["one", "two"]
    assert kept[0]["figures"]["total"] == {
        "value": 1.5,
        "unit": "s",
        "min": 1.0,
        "max": 2.0,
        "samples": 2,
    }
    assert read_json(path)["one"].facts == {"n": 64}


@pytest.mark.parametrize(
    "content", ["", "{}", "[1]", '[{"name": "x"}]', '[{"name": "x", "figures": {"a": {}}}]']
)
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "x.json"
    path.write_text(content)
    if content == "{}":
        assert read_json(path) == {}
        return
    with pytest.raises(ValueError, match="no results of a benchmark"):
        read_json(path)


def test_comparison_tells_change_from_noise(tmp_path):
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    write_json(
        old,
        [
            record("same", 1.0, 1.1, 1.2),
            record("slower", 1.0, 1.1, 1.2),
            record("faster", 1.0, 1.1, 1.2),
            record("gone", 1.0),
        ],
    )
    write_json(
        new,
        [
            record("same", 1.1, 1.15, 1.3),
            record("slower", 2.0, 2.2, 2.4),
            record("faster", 0.5, 0.6, 0.7),
            record("new", 1.0),
        ],
    )
    lines = {line.split()[0]: line for line in comparison(old, new).splitlines()}
    assert lines["same"].endswith("within noise")
    assert lines["slower"].endswith("more")
    assert "2.000  [1.667, 2.400]" in lines["slower"]
    assert lines["faster"].endswith("less")
    assert {"gone", "new"}.isdisjoint(lines)
    assert bounds(Figure(2.0), Figure(3.0)) == (1.5, 1.5)
    write_json(new, [record("new", 1.0)])
    with pytest.raises(ValueError, match="no figure in common"):
        comparison(old, new)


def test_report_and_charts(tmp_path):
    charts = [
        Bars("b", "bars", "s", {"one": 1.0, "two": 20.0}, limit=5.0, logarithmic=True),
        RecordLines("l", "lines", "x", "y", {"c": ([1, 2], [1e-3, 1e-5])}),
    ]
    images = report.draw(charts, tmp_path, "x")
    assert [image.name for image in images] == ["x-b.png", "x-l.png"]
    assert all(image.read_bytes().startswith(b"\x89PNG") for image in images)
    where = BenchmarkRecord("machine", {}, {"date": "today", "hardware": {"cpu": "Z80"}})
    report.write_markdown(
        tmp_path / "x.md",
        "Title",
        where,
        [RecordTable("T", ["a", "b"], [["1", "2|3"]], "Remark.")],
        images,
    )
    text = (tmp_path / "x.md").read_text()
    assert "# Title\n" in text
    assert "- hardware: cpu Z80" in text
    assert "| 1 | 2/3 |" in text
    assert "![x-b](x-b.png)" in text


def test_no_charts_without_matplotlib(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "present", lambda name: False)
    assert report.draw([Bars("b", "bars", "s", {"one": 1.0})], tmp_path, "x") == []
    assert not machine.present("no-such-distribution")
    where = BenchmarkRecord("machine", {}, {"date": "today"})
    said = report.write(
        "x", "Title", Results([where], [], [Bars("b", "bars", "s", {"one": 1.0})]), tmp_path
    )
    assert said[0].startswith("no plots: Matplotlib is missing (pip install")
    assert {path.name for path in tmp_path.iterdir()} == {"x.json", "x.md"}


def test_targets():
    assert RecordTarget("x", 2, Figure(1.5)).met
    assert not RecordTarget("x", 2, Figure(1.5), at_least=True).met
    assert RecordTarget("x", 2, None).row() == ["x", "<= 2", "not measured here", ""]
    assert RecordTarget("x", 40, Figure.of([30.0, 41.0, 43.0]), " x", True).row() == [
        "x",
        ">= 40 x",
        "41 x (30 to 43)",
        "yes",
    ]


def test_array_bytes_count_memory_once():
    before = array_bytes()
    a = wp.zeros(1000, dtype=wp.float64, device="cpu")
    views = [a[10:20], a.reshape((10, 100)), a.flatten()]
    assert array_bytes() - before == 8000
    del a, views
    assert array_bytes() == before
    assert resident_bytes() > 1 << 20


def test_stopwatch_puts_functions_back():
    plain = json.dumps
    with timed("cpu", {"dump": (json, "dumps")}) as seconds:
        assert json.dumps([1]) == "[1]"
        json.dumps([2])
    assert len(seconds["dump"]) == 2
    assert json.dumps is plain


def test_kept_results_can_be_read():
    kept = sorted(Path(benchmarks.__file__).parent.glob("results/*/*.json"))
    assert all("machine" in read_json(path) and path.with_suffix(".md").is_file() for path in kept)
    assert all(read_json(path)["machine"].facts["hardware"]["cpu"] for path in kept)


def test_kept_results_are_small():
    kept = Path(benchmarks.__file__).parent / "results"
    sizes = {path: path.stat().st_size for path in kept.rglob("*") if path.is_file()}
    # `validation` has 610 figures and 25 plots, `host` 80 kB, `choose` every method on 69 problems,
    # `ptxas.tsv` 147 kB: 1,852 kernels on three architectures.
    assert sum(sizes.values()) < 2.65e6
    assert {path.suffix for path in sizes} == {".json", ".md", ".png", ".tsv"}
