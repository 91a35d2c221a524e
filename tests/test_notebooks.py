"""Every notebook runs from top to bottom as it is."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def test_there_are_notebooks():
    assert [n.name for n in NOTEBOOKS][:5] == [
        "01_law.ipynb",
        "02_paper_calibration.ipynb",
        "03_least_squares.ipynb",
        "04_posterior.ipynb",
        "05_discovery.ipynb",
    ]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda n: n.stem)
@pytest.mark.filterwarnings("default")
def test_notebook_runs(notebook):
    content = nbformat.read(notebook, as_version=4)
    nbformat.validate(content)
    assert not any(cell.get("outputs") for cell in content.cells), "commit notebooks without outputs"
    NotebookClient(content, timeout=300, kernel_name="python3").execute()
    pictures = [o for cell in content.cells for o in cell.get("outputs", []) if "image/png" in o.get("data", {})]
    assert len(pictures) >= 3
