"""What takes numbers, options and arrays, called with what people mistype: it converts, or refuses in one line."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def walked():
    """What `walk_api.py` reports of every call."""
    script = Path(__file__).with_name("walk_api.py")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_lists_series_and_arrays_give_the_same(walked):
    tried = {
        f"{name}({mistake})": came
        for name, mistakes in walked.items()
        for mistake, came in mistakes.items()
        if mistake.endswith(("a list", "a Series"))
    }
    assert len(tried) > 25
    assert not {call: came for call, came in tried.items() if came != "same"}


def test_misspelt_options_wrong_sizes_and_unequal_lengths_are_refused(walked):
    tried = {
        f"{name}({mistake})": came
        for name, mistakes in walked.items()
        for mistake, came in mistakes.items()
        if not mistake.endswith(("a list", "a Series"))
    }
    assert len(tried) > 400
    assert not {call: came for call, came in tried.items() if not came.startswith("refused: ")}


def test_a_misspelt_option_is_refused_with_the_choices(walked):
    tried = {
        f"{name}({mistake})": came
        for name, mistakes in walked.items()
        for mistake, came in mistakes.items()
        if mistake.endswith("misspelt")
    }
    assert len(tried) > 25
    assert not {call: came for call, came in tried.items() if "mispelt" not in came}
    without = {call: came for call, came in tried.items() if not any(w in came for w in ("Choices: ", "Known: "))}
    assert not without
