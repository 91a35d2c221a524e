"""What takes numbers, options and arrays, called with what people mistype: it converts, or refuses in one line."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

CONVERTED = ("a list", "a Series")


@pytest.fixture(scope="module")
def walked():
    """What `walk_api.py` reports of every call, by the call and the mistake in it."""
    script = Path(__file__).with_name("walk_api.py")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    return {f"{name}({mistake})": came for name, mistakes in found.items() for mistake, came in mistakes.items()}


def test_lists_series_and_arrays_give_the_same(walked):
    tried = {call: came for call, came in walked.items() if call[:-1].endswith(CONVERTED)}
    assert len(tried) > 25
    assert set(tried.values()) == {"same"}, tried


def test_misspelt_options_wrong_sizes_and_unequal_lengths_are_refused(walked):
    """A misspelt option with the choices there are."""
    tried = {call: came for call, came in walked.items() if not call[:-1].endswith(CONVERTED)}
    assert len(tried) > 380
    assert not {call: came for call, came in tried.items() if not came.startswith("refused: ")}
    misspelt = [came for call, came in tried.items() if call.endswith("misspelt)")]
    assert len(misspelt) > 25
    assert not [came for came in misspelt if "mispelt" not in came or not ("Choices: " in came or "Known: " in came)]
