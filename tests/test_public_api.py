"""Everything public, called once with what people mistype: it converts what is meant, or refuses it in one line."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

MADE_BY_THE_LIBRARY = {
    *("mcc_jax.Posterior", "mcc_jax.Discovery", "mcc_jax.Energy", "mcc_jax.Identifiability"),
    *("mcc_jax.Evidence", "mcc_jax.Fit", "mcc_jax.campaign.TurningForces"),
    *("mcc_jax.LeastSquares", "mcc_jax.PaperCalibration", "mcc_jax.Power", "mcc_jax.PredictedCurves"),
    *("mcc_jax.InputError", "mcc_jax.Record", "mcc_jax.Response"),
    *(f"mcc_jax.campaign.{name}" for name in ("Adjustment", "Finding", "LoadingCurve")),
    *(f"mcc_jax.effects.{name}" for name in ("Context", "Equivalence", "Nuisance")),
    *(f"mcc_jax.calibrate.{name}" for name in ("ElasticBranch", "ElasticFit", "MasterCurve", "ParticleFit")),
    *(f"mcc_jax.calibrate.{name}" for name in ("PlasticFit", "ShapeFit", "StrainTable")),
    "mcc_jax.calibrate.FittedCurve",
    *(f"mcc_jax.discover.{name}" for name in ("Closure", "Effect")),
    *(f"mcc_jax.dem.{name}" for name in ("Band", "Compaction", "CompactionFit", "ContactEnergy", "Edges", "Forces")),
    *(f"mcc_jax.dem.{name}" for name in ("HalfContact", "LoadStep", "Motion", "Packing", "PopulationPacking")),
    *(f"mcc_jax.dem.{name}" for name in ("Replayed", "Segment", "Sensitivity", "State", "Trajectory", "WallHistory")),
    *("mcc_jax.export.Artefact", "mcc_jax.export.CurveTables", "mcc_jax.report.Results"),
}
"""Records that functions of the library fill in; nobody else makes them, so they take what they are given."""


@pytest.fixture(scope="module")
def walked():
    """What `walk_api.py` reports of every call."""
    script = Path(__file__).with_name("walk_api.py")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_everything_public_refuses_what_is_of_the_wrong_kind_in_one_line(walked):
    calls = {name: came for name, came in walked["nonsense"].items() if name not in MADE_BY_THE_LIBRARY and came}
    assert len(calls) > 150
    # The text "nonsense" is a fine name of a file, and of a plan.
    wrong = [
        f"{name}: {one}"
        for name, came in calls.items()
        for one in came
        if not one.startswith("refused: ") and (name, one) not in TEXT_IS_FINE
    ]
    wrong += [f"{name}: {one}" for name, came in calls.items() for one in came if "\n" in one]
    assert not wrong


TEXT_IS_FINE = {("mcc_jax.campaign.file_checksums", "accepted")}


def test_records_that_are_not_checked_are_still_there(walked):
    assert set(walked["nonsense"]) >= MADE_BY_THE_LIBRARY


def test_lists_series_and_arrays_give_the_same(walked):
    tried = {
        f"{name}({mistake})": came
        for name, mistakes in walked["mistakes"].items()
        for mistake, came in mistakes.items()
        if mistake.endswith(("a list", "a Series"))
    }
    assert len(tried) > 30
    assert not {call: came for call, came in tried.items() if came != "same"}


def test_misspelt_options_wrong_sizes_and_unequal_lengths_are_refused(walked):
    tried = {
        f"{name}({mistake})": came
        for name, mistakes in walked["mistakes"].items()
        for mistake, came in mistakes.items()
        if not mistake.endswith(("a list", "a Series"))
    }
    assert len(tried) > 400
    assert not {call: came for call, came in tried.items() if not came.startswith("refused: ")}


def test_a_misspelt_option_is_refused_with_the_choices(walked):
    tried = {
        f"{name}({mistake})": came
        for name, mistakes in walked["mistakes"].items()
        for mistake, came in mistakes.items()
        if mistake.endswith("misspelt")
    }
    assert len(tried) > 20
    assert not {call: came for call, came in tried.items() if "mispelt" not in came}
    without = {call: came for call, came in tried.items() if not any(w in came for w in ("Choices: ", "Known: "))}
    assert not without
