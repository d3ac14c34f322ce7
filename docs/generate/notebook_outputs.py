"""Run the cells of notebooks, without Jupyter, and store their output.

Run `python docs/generate/notebook_outputs.py [NAME]...`.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("*.ipynb"))
DOTS = 80  # dots per inch of a picture


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the code cells."""
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def printed(notebook: dict[str, Any], pictures: list[list[bytes]] | None = None) -> list[str]:
    """Run the code cells in one name space; return the printed text of each.

    Args:
        notebook: contents of the notebook's file.
        pictures: list to which the PNG files of each cell's figures are appended.
    """
    names: dict[str, Any] = {}
    texts = []
    for number, cell in enumerate(code_cells(notebook)):
        stream = io.StringIO()
        with contextlib.redirect_stdout(stream):
            exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
        texts.append(stream.getvalue())
        if pictures is not None:
            pictures.append(drawn(names["plt"]))
    return texts


def drawn(plt: Any) -> list[bytes]:
    """Return the open figures as PNG files, and close them."""
    pictures = []
    for figure in map(plt.figure, plt.get_fignums()):
        file = io.BytesIO()
        figure.savefig(
            file, format="png", dpi=DOTS, bbox_inches="tight", metadata={"Software": None}
        )
        pictures.append(file.getvalue())
    plt.close("all")
    return pictures


def kept(notebook: dict[str, Any]) -> list[str]:
    """Return the stored printed text of each code cell."""
    return [
        "".join("".join(output.get("text", "")) for output in cell["outputs"])
        for cell in code_cells(notebook)
    ]


def outputs(text: str, pictures: list[bytes], alt: str) -> list[dict[str, Any]]:
    """Return the outputs of a cell in the format of a notebook."""
    lines = text.splitlines(keepends=True)
    shown = [
        {"image/png": base64.b64encode(picture).decode(), "text/plain": [alt]}
        for picture in pictures
    ]
    return [
        *([{"name": "stdout", "output_type": "stream", "text": lines}] if lines else []),
        *({"data": data, "metadata": {}, "output_type": "display_data"} for data in shown),
    ]


if __name__ == "__main__":
    import matplotlib

    matplotlib.use("agg")
    for path in NOTEBOOKS:
        if not sys.argv[1:] or path.stem in sys.argv[1:]:
            content = json.loads(path.read_text())
            images: list[list[bytes]] = []
            for cell, text, found in zip(
                code_cells(content), printed(content, images), images, strict=True
            ):
                cell["outputs"] = outputs(text, found, cell["metadata"].get("alt", ""))
            path.write_text(json.dumps(content, indent=1) + "\n")
