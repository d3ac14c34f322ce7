"""What the checks found as one HTML page that needs nothing else: no script, no network, no image file; it prints as it reads."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from warp_lcp.benchmarks import svg
from warp_lcp.benchmarks.record import Chart, Lines, Record
from warp_lcp.benchmarks.validation.finding import Finding, Trial

STYLE = """
:root { color-scheme: light; font-size: 15px; }
body { margin: 0 auto; max-width: 62rem; padding: 1rem 1.5rem 3rem; background: #fff; color: #1c2733;
  font: 1rem/1.5 system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; }
h1 { font-size: 1.7rem; margin: 0.6rem 0 0.2rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 0.3rem; padding-top: 0.6rem; border-top: 1px solid #d5dce3; }
p { max-width: 50rem; }
a { color: #0b5394; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.1rem 1rem; font-size: 0.9rem; }
dt { color: #5b6b7b; } dd { margin: 0; }
table { border-collapse: collapse; width: 100%; margin: 0.8rem 0; font-size: 0.87rem; }
th, td { text-align: left; padding: 0.22rem 0.5rem; border-bottom: 1px solid #e4e9ee; vertical-align: top; }
th { color: #5b6b7b; font-weight: 600; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.resolution td { background: #eef2f6; font-weight: 600; }
tr.control td { background: #faf7f0; }
.verdict { white-space: nowrap; font-weight: 600; }
.good { color: #1a6e3c; } .bad { color: #a61b1b; }
.note { border-left: 4px solid #a61b1b; padding: 0.1rem 0.9rem; background: #fdf3f2; }
figure { margin: 1rem 0; break-inside: avoid; }
svg.chart { width: 100%; max-width: 46rem; height: auto; font: 12px system-ui, "DejaVu Sans", Arial, sans-serif; }
svg.chart text { fill: #1c2733; } svg.chart .chart-title { font-size: 13px; font-weight: 600; }
svg.chart .grid { stroke: #e1e6eb; } svg.chart .axes { fill: none; stroke: #4a5866; } svg.chart .curve { fill: none; stroke-width: 1.6; }
@page { size: A4; margin: 14mm; }
@media print { :root { font-size: 10.5px; } body { max-width: none; padding: 0; } svg.chart { max-width: 38rem; }
  a { color: inherit; text-decoration: none; }
  tr, .note { break-inside: avoid; } h2, h2 + p, thead, tr.resolution { break-after: avoid; } thead { display: table-header-group; }
  tr.resolution td, tr.control td, .note { -webkit-print-color-adjust: exact; print-color-adjust: exact; } }
"""


@dataclass(frozen=True)
class Section:
    """One check of the page.

    Args:
        name: of the check.
        text: what it is about.
        trials: what was found, at each resolution.
        charts: of it.
        known: why it is known not to hold everywhere; empty if it is expected to hold.
    """

    name: str
    text: str
    trials: Sequence[Trial]
    charts: Sequence[Chart]
    known: str = ""

    @property
    def anchor(self) -> str:
        """What links to it name."""
        return re.sub(r"\W+", "-", self.name)


def page(title: str, machine: Record, sections: Sequence[Section]) -> str:
    """Return the page."""
    body = [
        f"<h1>{escape(title)}</h1>",
        _count(sections),
        _machine(machine),
        *_summary(sections),
        *_misses(sections),
        *(part for section in sections for part in _section(section)),
    ]
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<link rel="icon" href="data:,">',  # or a browser asks for one
            f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )


def _count(sections: Sequence[Section]) -> str:
    """Return the sums of all checks."""
    findings = [f for s in sections for t in s.trials for f in t.findings]
    own, controls = [f for f in findings if not f.control], [f for f in findings if f.control]
    seconds = sum(t.seconds for s in sections for t in s.trials)
    return (
        f"<p><strong>{sum(f.passed for f in own)} of {len(own)} figures keep their tolerance, and {sum(f.passed for f in controls)} of "
        f"{len(controls)} negative controls fail theirs, as they must</strong>; {seconds:.0f} s in all. A negative control is a set-up "
        "that is wrong on purpose: a check that it passes would prove nothing.</p>"
    )


def _machine(machine: Record) -> str:
    """Return where and when it was measured, with versions."""
    rows = [f"<dt>{escape(name)}</dt><dd>{escape(_text(value))}</dd>" for name, value in machine.facts.items()]
    return f"<dl>{''.join(rows)}</dl>"


def _text(value: Any) -> str:
    return ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, Mapping) else str(value)


def _summary(sections: Sequence[Section]) -> list[str]:
    """Return a table with a row for each check."""
    rows = []
    for s in sections:
        found = [f for t in s.trials for f in t.findings]
        own, controls = [f for f in found if not f.control], [f for f in found if f.control]
        good = all(t.passed for t in s.trials)
        verdict = _verdict("as it must be", True) if good else _verdict("not all as it must be", False)
        cells = [f"{sum(f.passed for f in kind)} of {len(kind)}" for kind in (own, controls)]
        rows.append(
            f'<tr><td><a href="#{s.anchor}">{escape(s.name)}</a></td><td class="number">{cells[0]}</td>'
            f'<td class="number">{cells[1]}</td><td class="number">{sum(t.seconds for t in s.trials):.1f}</td><td>{verdict}</td></tr>'
        )
    head = (
        '<tr><th>check</th><th class="number">within tolerance</th><th class="number">controls that fail</th>'
        '<th class="number">seconds</th><th>verdict</th></tr>'
    )
    return [f"<table><thead>{head}</thead><tbody>", *rows, "</tbody></table>"]


def _misses(sections: Sequence[Section]) -> list[str]:
    """Return what is not as it must be, a line each."""
    lines = [line for s in sections for t in s.trials for line in t.failures()]
    if not lines:
        return []
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return [f'<div class="note"><p>Not as it must be:</p><ul>{items}</ul></div>']


def _section(section: Section) -> list[str]:
    """Return a check: what it is, its figures, its plots."""
    parts = [f'<h2 id="{section.anchor}">{escape(section.name)}</h2>', f"<p>{escape(section.text)}</p>"]
    if section.known and not all(t.passed for t in section.trials):
        parts.append(f'<p class="note">Known: {escape(section.known)}.</p>')
    head = '<tr><th>figure</th><th class="number">value</th><th>tolerance</th><th>verdict</th></tr>'
    parts.append(f"<table><thead>{head}</thead><tbody>")
    for t in section.trials:
        parts.append(f'<tr class="resolution"><td colspan="4">{escape(t.name)} ({t.seconds:.1f} s)</td></tr>')
        parts += [_row(f) for f in sorted(t.findings, key=lambda f: f.control)]
        if t.error:
            parts.append(f'<tr><td colspan="3">ended early: {escape(t.error)}</td><td>{_verdict("fails", False)}</td></tr>')
    parts.append("</tbody></table>")
    drawn = [chart for chart in section.charts if isinstance(chart, Lines) and chart.curves]
    return [*parts, *(f"<figure>{svg.draw(chart)}</figure>" for chart in drawn)]


def _row(finding: Finding) -> str:
    """Return the row of a figure."""
    unit = f" {finding.unit}" if finding.unit else ""
    value = "not measured" if math.isnan(finding.value) else f"{finding.value:.4g}{unit}"
    bound = f"must break {finding.bound}" if finding.control else finding.bound
    words = {
        (False, True): "keeps it", (False, False): "FAILS", (True, True): "breaks it, as it must", (True, False): "does NOT break it",
    }[finding.control, finding.passed]  # fmt: skip
    return (
        f'<tr{" class=control" if finding.control else ""}><td>{escape(finding.what)}</td><td class="number">{escape(value)}</td>'
        f"<td>{escape(bound)}</td><td>{_verdict(words, finding.passed)}</td></tr>"
    )


def _verdict(words: str, good: bool) -> str:
    return f'<span class="verdict {"good" if good else "bad"}">{"&#10003;" if good else "&#10007;"} {escape(words)}</span>'
