"""Run the notebooks and keep what they print and draw: `python -m tests.run_notebooks [PART OF A NAME]`.

The outputs are committed: who only looks sees the results. `tests/test_notebooks.py` runs them again and compares.
"""

import base64
import io
import json
import re
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat.v4.rwbase import split_lines
from PIL import Image

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST, LARGEST_NOTEBOOK = 60_000, 1_500_000
"""Bytes of one picture, and of a notebook with its outputs."""


def executed(notebook: Path, timeout_s: int = 900) -> nbformat.NotebookNode:
    """A notebook with what it gives when it runs from top to bottom, its pictures made small."""
    content = nbformat.read(notebook, as_version=4)
    for cell in content.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    place = {"metadata": {"path": FOLDER}}
    NotebookClient(content, timeout=timeout_s, kernel_name="python3", resources=place).execute()
    for cell in content.cells:
        cell.metadata = {key: value for key, value in cell.metadata.items() if key != "execution"}
        if cell.cell_type != "code":
            continue
        cell.outputs = [one for one in cell.outputs if one.get("name") != "stderr"]
        for one in cell.outputs:
            data = one.get("data", {})
            if "image/png" in data:
                data["image/png"] = _small(data["image/png"])
            if "text/html" in data:
                data["text/html"] = re.sub(
                    r"(data:image/png;base64,)([A-Za-z0-9+/=\\\n]+)",
                    lambda match: match[1] + _small(match[2].replace("\\\n", "")),
                    data["text/html"],
                )
    content.metadata = {"kernelspec": content.metadata["kernelspec"], "language_info": {"name": "python"}}
    return content


def _small(picture: str) -> str:
    """The picture with fewer colours, and where that is not enough with fewer pixels: at most `LARGEST` bytes."""
    whole = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
    for colours, scale in ((96, 1.0), (32, 1.0), (16, 1.0), (32, 0.8), (16, 0.7), (16, 0.5)):
        one = whole if scale == 1 else whole.resize((int(scale * whole.width), int(scale * whole.height)))
        stream = io.BytesIO()
        one.quantize(colours, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
        if stream.tell() <= LARGEST:
            break
    return base64.b64encode(stream.getvalue()).decode("ascii")


def write(notebook: Path, content: nbformat.NotebookNode) -> None:
    """Write a notebook as the others are written."""
    # A line of text a line of the file, so that a comparison of two versions reads.
    lines = split_lines(nbformat.from_dict(content))
    text = json.dumps(lines, indent=1, ensure_ascii=False, sort_keys=True)
    notebook.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    for notebook in NOTEBOOKS:
        if len(sys.argv) < 2 or any(part in notebook.stem for part in sys.argv[1:]):
            write(notebook, executed(notebook))
            print(f"{notebook.name}: {notebook.stat().st_size // 1000} kB", flush=True)
