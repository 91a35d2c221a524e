"""Every notebook holds its results, and gives them again when it runs from top to bottom."""

import base64
import re

import nbformat
import pytest
from run_notebooks import LARGEST, LARGEST_NOTEBOOK, NOTEBOOKS, executed

NUMBER = re.compile(r"(?<![\w.])[-−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
CLOSE, NEAR_ZERO, NOTHING = 0.05, 1e-3, 1e-6
"""How far a number may be from the stored one: five per cent, a thousandth of the largest in its line, one in its last
decimal place, or, of what should be zero, a millionth. Another processor adds in another order, which moves where an
optimiser stops.
"""


def pictures(content):
    """Every picture, by the number of its cell."""
    return [
        (i, base64.b64decode(one["data"]["image/png"]))
        for i, cell in enumerate(content.cells)
        for one in cell.get("outputs", [])
        if "image/png" in one.get("data", {})
    ]


def printed(content):
    """What every cell prints or shows as text; names of objects in memory are no result."""
    found = []
    for i, cell in enumerate(content.cells):
        parts = [one.get("text", one.get("data", {}).get("text/plain", "")) for one in cell.get("outputs", [])]
        found.append((i, re.sub(r"<[^<>\n]* (?:at 0x\w+|object)>", "<>", "".join(parts))))
    return found


def differences(kept, again):
    """Cells whose words differ, or whose numbers do by more than they may."""
    found = []
    for (i, one), (_, two) in zip(printed(kept), printed(again), strict=True):
        words, others = (" ".join(NUMBER.sub("#", text).split()) for text in (one, two))
        if words != others:
            found.append(f"cell {i}: {words[:200]!r} is now {others[:200]!r}")
            continue
        for line, other in zip(one.splitlines(), two.splitlines(), strict=False):
            if any(_apart(*pair, line) for pair in zip(NUMBER.findall(line), NUMBER.findall(other), strict=False)):
                found.append(f"cell {i}: {line!r} is now {other!r}")
    return found


def _apart(kept, again, line):
    """Whether two numbers, as they are printed in a line, are further apart than they may be."""
    one, two = (float(text.replace("−", "-")) for text in (kept, again))
    most = max(abs(float(text.replace("−", "-"))) for text in NUMBER.findall(line))
    decimals = len(kept.partition(".")[2]) if "e" not in kept else 0
    last = 1.01 * 10.0**-decimals if decimals else 0.0
    return abs(one - two) > max(CLOSE * abs(one), NEAR_ZERO * most, last, NOTHING)


NAMES = ["01_law", "02_paper_calibration", "03_least_squares", "04_posterior", "05_discovery", "06_dem"]


def test_notebooks_hold_their_results_and_are_small():
    assert [n.stem for n in NOTEBOOKS][:6] == NAMES
    for notebook in NOTEBOOKS:
        content = nbformat.read(notebook, as_version=4)
        nbformat.validate(content)
        assert notebook.stat().st_size <= LARGEST_NOTEBOOK
        shown = pictures(content)
        assert len(shown) >= 3, notebook.name
        assert all(len(picture) <= LARGEST for _, picture in shown), notebook.name
        for cell in content.cells:
            if cell.cell_type == "code":
                assert cell.execution_count is not None, "run it: python -m tests.run_notebooks"
                assert not any(one.output_type == "error" for one in cell.outputs)


@pytest.mark.notebook
@pytest.mark.parametrize("notebook", NOTEBOOKS[::-1], ids=lambda n: n.stem)  # the last take longest
@pytest.mark.filterwarnings("default")
def test_notebook_gives_its_results_again(notebook):
    kept, again = nbformat.read(notebook, as_version=4), executed(notebook)
    assert [i for i, _ in pictures(kept)] == [i for i, _ in pictures(again)]
    assert differences(kept, again) == []


def test_a_drifted_result_is_seen():
    def notebook(text):
        output = nbformat.v4.new_output("stream", text=text)
        return nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("", outputs=[output])])

    kept = notebook("a = 1.4289 ± 0.0012, verdict NAMED, gap 2e-16")
    assert differences(kept, notebook("a = 1.4291 ± 0.0012, verdict NAMED, gap 5e-16")) == []
    assert differences(notebook("12 of 12"), notebook("11 of 12"))
    assert differences(kept, notebook("a = 1.6 ± 0.0012, verdict NAMED, gap 2e-16"))
    assert differences(kept, notebook("a = 1.4289 ± 0.0012, verdict SET, gap 2e-16"))
