"""Run the built-in scenes, draw each and write docs/gallery.md.

Run `python docs/generate/gallery.py [--scene NAME]... [--work DIR]`. Other scenes keep their
picture and their figures, which are stored in docs/gallery/figures.json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tomllib
from datetime import date
from importlib.resources import files
from pathlib import Path
from typing import Any

from PIL import Image

from warp_lcp.benchmarks.harness.machine import cpu_model

DOCS = Path(__file__).parents[1]
PAGE, FOLDER = DOCS / "gallery.md", DOCS / "gallery"
FIGURES = FOLDER / "figures.json"
PICTURES = 3  # pictures of a sheet: early, in the middle, late
SIZE = "1500x480"  # pixels of one row
# Settings of 3-D scenes, in addition to their own.
SETTINGS = {"fluids": ("output.surface=true",), "granular": (), "contacts": ()}
SURFACE = ("--show", "surface")
PHOTOS = {  # frames drawn by `render --look photo`
    "column-collapse": 9,
    "crown-splash": 12,
    "dam-break": 30,
    "hourglass": 20,
    "mesh-obstacle": 14,
    "pouring-pile": 50,
    "stirred-tank": 37,
    "waterfall": 90,
}
PHOTO_SIZE, PHOTO_SAMPLES = "800x450", "48"

HEAD = """# Gallery

<!-- Written by docs/generate/gallery.py from runs of the scenes; do not edit. -->

All built-in scenes. To run and draw one:

```sh
warp-lcp run dam-break --set output.surface=true
warp-lcp render out/dam-break --sheet
```

`output.surface=true` adds the surface of a liquid; omit it for sand and in 2-D.
`--set domain.resolution=128` refines. Pictures of one frame are made by
[`--look photo`](frames-and-films.md#photographs).

Run times are of one core of a shared {device},
{date}; bodies alone on an AMD EPYC.
"""


def scene_text(name: str) -> str:
    """Return the text of a built-in scene."""
    return (files("warp_lcp.scene.scenes") / f"{name}.toml").read_text()


def scene_names() -> list[str]:
    """Return the built-in scenes: liquids, sand, bodies alone."""
    names = [
        Path(entry.name).stem
        for entry in files("warp_lcp.scene.scenes").iterdir()
        if entry.name.endswith(".toml")
    ]
    return sorted(
        names,
        key=lambda name: (
            [*SETTINGS].index(tomllib.loads(scene_text(name))["scene"]["simulator"]),
            name,
        ),
    )


def commands(name: str) -> tuple[list[str], list[str]]:
    """Return the commands that run and draw a scene, without folders."""
    scene = tomllib.loads(scene_text(name))
    simulator = scene["scene"]["simulator"]
    deep = len(scene["domain"]["size"]) == 3
    settings = SETTINGS[simulator] if deep else ()
    run = ["warp-lcp", "run", name, *(word for setting in settings for word in ("--set", setting))]
    draw = ["warp-lcp", "render", f"out/{name}", "--sheet"]
    return run, draw + (list(SURFACE) if settings else [])


def measured(command: list[str]) -> int:
    """Run a command; return its peak memory [bytes]."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    return usage.ru_maxrss * 1024


def show(name: str, work: Path) -> dict[str, Any]:
    """Run a scene, store its picture and return its figures."""
    program = Path(sys.executable).parent / "warp-lcp"
    out, (run, draw) = work / name, commands(name)
    memory = measured([str(program), *run[1:], "--out", str(out), "--force"])
    end = json.loads((out / "run.json").read_text())
    last = end["frames"]
    if name in PHOTOS:
        shot = [
            "--look",
            "photo",
            "--frame",
            str(PHOTOS[name]),
            "--shutter",
            "0",
            "--size",
            PHOTO_SIZE,
            "--samples",
            PHOTO_SAMPLES,
        ]
        measured([str(program), "render", str(out), *shot])
        picture = Image.open(out / "photo" / f"photo_{PHOTOS[name]:06d}.png")
    else:
        picture = _sheet(program, out, draw[3:], last)
    FOLDER.mkdir(exist_ok=True)
    picture.convert("RGB").save(FOLDER / f"{name}.webp", quality=82, method=6)
    return {
        "seconds": end["seconds"],
        "steps": end["steps"],
        "frames": last + 1,
        "megabytes": round(memory / 2**20),
        "note": end["warnings"][0],
    }


def _sheet(program: Path, out: Path, options: list[str], last: int) -> Image.Image:
    """Return three frames of a run side by side."""
    chosen = [
        word
        for part in range(1, PICTURES + 1)
        for word in ("--frame", str(round(last * part / (PICTURES + 1) * 4 / 3)))
    ]
    measured([str(program), "render", str(out), *options, *chosen, "--size", SIZE])
    return Image.open(out / "images" / "sheet.png")


def entry(name: str, figures: dict[str, Any]) -> str:
    """Return the section of a scene on the page."""
    about = tomllib.loads(scene_text(name))["scene"]
    description = about["description"][0].upper() + about["description"][1:].partition(" (")[0]
    return (
        f"## {name}\n\n![{name}](gallery/{name}.webp)\n\n{description}. "
        f"{figures['seconds']:.0f} s.\n"
    )


def page(figures: dict[str, Any]) -> str:
    """Return the page."""
    head = HEAD.format(device=figures["device"], date=figures["date"])
    return "\n".join([head, *(entry(name, figures["scenes"][name]) for name in scene_names())])


def main() -> None:
    """Run the requested scenes, all by default."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", action="append", choices=scene_names(), help="may be repeated")
    parser.add_argument("--work", type=Path, default=Path("out/gallery"), help="where the runs go")
    asked = parser.parse_args()
    figures = json.loads(FIGURES.read_text()) if FIGURES.is_file() else {"scenes": {}}
    figures |= {"device": cpu_model(), "date": date.today().isoformat()}
    for name in asked.scene or scene_names():
        figures["scenes"][name] = show(name, asked.work)
        print(name, figures["scenes"][name], flush=True)
        FIGURES.write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
    PAGE.write_text(page(figures))


if __name__ == "__main__":
    main()
