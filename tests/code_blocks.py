"""Parser of Markdown for tests: code blocks, headings with anchors, links."""

import linecache
import re
import unicodedata
from pathlib import Path

FENCE = re.compile(r"^```.*?^```$", flags=re.S | re.M)


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), flags=re.S)


def prose(page: Path) -> str:
    """Return a page without its code blocks."""
    return FENCE.sub("", page.read_text())


def run(code: str, page: Path) -> None:
    """Run a block in its own name space, with sources available to its kernels."""
    linecache.cache[page.name] = (len(code), None, code.splitlines(keepends=True), page.name)
    exec(compile(code, page.name, "exec"), {"__name__": f"block_of_{page.stem}"})


def sponge() -> type:
    """Return the class of the page of a user's own model, without its final run."""
    page = Path(__file__).parents[1] / "docs" / "own-model.md"
    code = blocks(page, "python")[0].split("scene = load_scene")[0]
    names: dict[str, type] = {}
    exec(compile(code, page.name, "exec"), names)
    return names["Sponge"]


def links(page: Path) -> list[str]:
    """Return the targets of a page's links and pictures."""
    return re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", prose(page)))


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as Python-Markdown makes them.

    And others where headings are plain.
    """
    counts: dict[str, int] = {}
    for heading in re.findall(r"^#+ (.*)$", prose(page), flags=re.M):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        text = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
        slug = re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower())
        counts[slug] = counts.get(slug, 0) + 1
    return {
        slug if count == 0 else f"{slug}_{count}"
        for slug, many in counts.items()
        for count in range(many)
    }
