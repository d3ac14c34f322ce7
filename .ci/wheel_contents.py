"""Build the wheel in three ways and check its contents.

The wheel is built from a checkout, from the source distribution, and from a checkout without
symbolic links, as git makes it on Windows. All three wheels must hold the sources, headers and
tables of `warp_lcp`, and nothing else; the source distribution holds all that is tracked, tests and
docs among it. Run this program in the repository by a Python with
setuptools: `python .ci/wheel_contents.py FOLDER`; the wheel goes into FOLDER.
"""

import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from zipfile import ZipFile

LINKED = ("fluids", "granular", "benchmarks")
SHIPPED = (".py", ".h", ".toml", ".html", ".typed")
# The links' folders are in source distributions at the top alone.
NOT_IN_SDIST = {".gitignore", ".pre-commit-config.yaml", *(f"warp_lcp/{name}" for name in LINKED)}


def tracked() -> list[Path]:
    """Return the tracked files that exist in the working tree."""
    names = subprocess.run(
        ["git", "ls-files", "-z"], check=True, capture_output=True, text=True
    ).stdout.split("\0")
    return [
        Path(name) for name in names if name and (Path(name).is_file() or Path(name).is_symlink())
    ]


def copied(tree: Path, *, links: bool) -> Path:
    """Copy the tracked files; links become text files unless `links` is set."""
    for name in tracked():
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        if name.is_symlink() and not links:
            (tree / name).write_text(str(name.readlink()))
        else:
            shutil.copyfile(name, tree / name, follow_symlinks=False)
    return tree


def built(tree: Path, kind: str, folder: Path) -> Path:
    """Build a wheel or sdist in a new folder and return its path."""
    folder.mkdir()
    code = f"from setuptools import build_meta; build_meta.build_{kind}({str(folder.resolve())!r})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tree, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{kind} of {tree}: {done.stderr}")
    return next(folder.iterdir())


def main(folder: Path) -> None:
    """Compare the contents of three wheels with the tracked files."""
    expected = set()
    for name in tracked():
        if (
            name.suffix in SHIPPED
            and name.parts[0] in ("warp_lcp", *LINKED)
            and name.parts[:2] != ("benchmarks", "results")
        ):
            expected.add(str(name if name.parts[0] == "warp_lcp" else "warp_lcp" / name))
    checkout = copied(folder / "checkout", links=True)
    with tarfile.open(built(checkout, "sdist", folder / "sdist")) as archive:
        archive.extractall(folder / "unpacked", filter="data")
        packed = {name.partition("/")[2] for name in archive.getnames()}
    left_out = {str(name) for name in tracked()} - packed - NOT_IN_SDIST
    if left_out:
        sys.exit(f"the source distribution lacks {sorted(left_out)}: see MANIFEST.in")
    trees = {
        "checkout": checkout,
        "sdist": next((folder / "unpacked").iterdir()),
        "unlinked": copied(folder / "unlinked", links=False),
    }
    for kind, tree in trees.items():
        wheel = built(tree, "wheel", folder / f"wheel-{kind}")
        with ZipFile(wheel) as archive:
            contents = {name for name in archive.namelist() if ".dist-info/" not in name}
        if contents != expected:
            sys.exit(
                f"the wheel of the {kind} lacks {sorted(expected - contents)} and has "
                f"{sorted(contents - expected)} besides"
            )
    print(
        f"{wheel.name}: {len(contents)} files, all of warp_lcp; the same of a source "
        "distribution and "
        "without symbolic links"
    )


main(Path(sys.argv[1]))
