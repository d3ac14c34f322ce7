"""Hook of MkDocs for pages of the site that are no Markdown files under docs.

Notebooks become pages, and so do files of the repository that pages link to. Formulas become
MathML, which browsers draw without a script, in the included font.
"""

from __future__ import annotations

import base64
import html
import json
import re
from importlib.metadata import distribution
from pathlib import Path, PurePosixPath
from typing import Any

NOTEBOOK = re.compile(r"\]\(((?:\.\./)?[\w-]+)\.ipynb\)")  # link to a notebook
FONT = "STIXTwoMath-Regular.ttf"  # font of ziamath; docs/site.css names it
# Script that the plug-in `offline` loads for the search, and our copy.
SHIM, OWN_SHIM = "https://unpkg.com/iframe-worker/shim", "iframe-worker.js"
# Link from a page directly under docs to a file of the repository, and from one in a folder there.
OUTSIDE = re.compile(r"\]\(\.\./([^)#\s]+)(#[^)]*)?\)")
FURTHER_OUTSIDE = re.compile(r"\]\(\.\./\.\./([^)#\s]+)(#[^)]*)?\)")
FOLDERS = ("api/", "design/")  # of pages under docs; others are files of the repository
# Output of pymdownx.arithmatex for $...$ and $$...$$.
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[([](.*?)\\[])]</\1>', flags=re.S)

LITERAL = re.compile(r"(<(pre|code|math)\b.*?</\2>|<[^>]*>)", flags=re.S)
POWER = re.compile(r"(?<=[\w)\]|])\^(?:\(([^)]*)\)|(-1/2|-?\d+(?:\.\d+)?|[a-z]\b))")


def page_of_notebook(text: str, name: str) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and its pictures by their file names.

    The page has the text, code, printed text and pictures.
    """
    parts, pictures = [], {}
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            if output["output_type"] == "stream":
                parts.append("```text\n" + "".join(output["text"]).rstrip("\n") + "\n```")
            else:
                file = f"{name}-{len(pictures) + 1}.png"
                pictures[file] = base64.b64decode(output["data"]["image/png"])
                parts.append(f"![{''.join(output['data']['text/plain'])}]({file})")
    return "\n\n".join(parts) + "\n", pictures


def outside_links(text: str, *, in_folder: bool = False) -> set[str]:
    """Return the repository files, relative to its root, that a page links to.

    The page is directly under docs, or in a folder there.
    """
    pattern = FURTHER_OUTSIDE if in_folder else OUTSIDE
    return {match[1] for match in pattern.finditer(text)}


def inside(text: str, *, in_folder: bool = False) -> str:
    """Return the page with these links made links within the site."""
    if in_folder:
        return FURTHER_OUTSIDE.sub(r"](../\1\2)", text)
    return OUTSIDE.sub(r"](\1\2)", text)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of notebooks, and files outside docs.

    The latter are those that the navigation and the pages name, and the files that these show.
    """
    from mkdocs.structure.files import File

    docs = Path(config.docs_dir)
    root = Path(config.config_file_path).parent
    for notebook in sorted(docs.glob("*.ipynb")):
        page, pictures = page_of_notebook(notebook.read_text(), notebook.stem)
        files.append(File.generated(config, f"{notebook.stem}.md", content=page))
        for picture, content in pictures.items():
            files.append(File.generated(config, picture, content=content))
    files.append(
        File.generated(
            config,
            FONT,
            abs_src_path=str(distribution("ziamath").locate_file(f"ziamath/fonts/{FONT}")),
        )
    )
    wanted = set().union(
        *(outside_links(page.read_text()) for page in docs.glob("*.md")),
        *(outside_links(page.read_text(), in_folder=True) for page in docs.glob("*/*.md")),
    )
    wanted |= set(re.findall(r"(benchmarks/\S+\.md|[A-Z]+\.md)", json.dumps(config.nav)))
    for name in sorted(wanted):
        path = root / name
        if path.suffix != ".md":
            files.append(File.generated(config, name, abs_src_path=str(path)))
            continue
        text = path.read_text()
        for shown in re.findall(r"\]\(([^):#\s]+)\)", text):
            source = PurePosixPath(name).parent / shown
            if (
                (root / source).is_file()
                and not shown.endswith(".md")
                and files.get_file_from_path(str(source)) is None
            ):
                files.append(File.generated(config, str(source), abs_src_path=str(root / source)))
        files.append(File.generated(config, name, content=text.replace("](docs/", "](")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Make links out of docs, and to notebooks, links within the site."""
    depth = page.file.src_uri.count("/")
    if depth == 0 or page.file.src_uri.startswith(FOLDERS):
        markdown = inside(markdown, in_folder=depth > 0)
    return NOTEBOOK.sub(r"](\1.md)", markdown)


def formula(match: re.Match[str]) -> str:
    """Return a TeX formula as MathML."""
    from latex2mathml.converter import convert

    mathml = convert(html.unescape(match[2]), display="block" if match[1] == "div" else "inline")
    if "\\" in mathml:
        raise ValueError(f"not all of this is TeX that can be drawn: {match[2]}")
    mathml = mathml.replace("<mo>&#x0221E;</mo>", "<mi>&#x0221E;</mi>").replace(
        "<mi>&#x027C2;</mi>", "<mo>&#x027C2;</mo>"
    )
    return f'<div class="formula">{mathml}</div>' if match[1] == "div" else mathml


def typeset(text: str) -> str:
    """Return text with raised powers and typeset comparison signs."""
    return (
        POWER.sub(lambda found: f"<sup>{found[1] or found[2]}</sup>", text)
        .replace("&lt;=", "≤")
        .replace("&gt;=", "≥")
    )


def on_page_content(content: str, **_: Any) -> str:
    """Typeset formulas, and similar text between tags and code."""
    parts = LITERAL.split(FORMULA.sub(formula, content))
    parts[::3] = map(typeset, parts[::3])
    return "".join(part for place, part in enumerate(parts) if place % 3 < 2)


def own_shim(output: str, path: str) -> str:
    """Return a page that takes the search script from the site.

    The page then fetches nothing from elsewhere. `path` is its path in the site.
    """
    return output.replace(SHIM, "../" * path.count("/") + OWN_SHIM)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Make the search work from the disk, without a network."""
    return own_shim(output, page.url)


def on_post_template(output: str, template_name: str, **_: Any) -> str:
    """Make the search work from the disk in files that are no pages."""
    return own_shim(output, template_name)
