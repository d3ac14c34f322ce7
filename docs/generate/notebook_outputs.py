"""Runs the notebooks' cells, without Jupyter, and keeps what they print: `python docs/generate/notebook_outputs.py`."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("*.ipynb"))


def printed(notebook: dict[str, Any]) -> list[str]:
    """Run the code cells one after the other in one name space; return what each printed."""
    names: dict[str, Any] = {}
    texts = []
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            stream = io.StringIO()
            with contextlib.redirect_stdout(stream):
                exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
            texts.append(stream.getvalue())
    return texts


def kept(notebook: dict[str, Any]) -> list[str]:
    """Return what the notebook holds as printed by its code cells."""
    cells = (cell for cell in notebook["cells"] if cell["cell_type"] == "code")
    return ["".join("".join(output["text"]) for output in cell["outputs"]) for cell in cells]


if __name__ == "__main__":
    for file in NOTEBOOKS:
        notebook = json.loads(file.read_text())
        texts = iter(printed(notebook))
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                text = next(texts)
                lines = text.splitlines(keepends=True)
                cell["outputs"] = [{"name": "stdout", "output_type": "stream", "text": lines}] if lines else []
        file.write_text(json.dumps(notebook, indent=1) + "\n")
