"""Priors from a file: what it changes, and what it says of a mistake."""

import dataclasses
import json

import pytest
from helpers import assert_holds, refusal

from mcc_jax import Model, Priors, Unloading
from mcc_jax.calibrate import LogNormalPrior, NakagamiPrior, NormalPrior, read_priors


@pytest.fixture
def read(tmp_path):
    def from_text(text, *arguments):
        file = tmp_path / "priors.toml"
        file.write_text(text, encoding="utf-8")
        return read_priors(file, *arguments)

    return from_text


def test_a_file_changes_what_it_names_and_nothing_else(read):
    assert read("# nothing\n") == Priors()
    found = read("[a]\nmean = 2\n[C1]\nmedian = 5\nlog_sd = 0.25\n[tau_C3]\nsd = 1\n")
    assert found.a == NormalPrior(2.0, Priors().a.sd)
    assert LogNormalPrior(5.0, 0.25) == found.C1
    assert found.tau_C3 == NakagamiPrior(1.0, Priors().tau_C3.shape)
    assert found == dataclasses.replace(Priors(), a=found.a, C1=found.C1, tau_C3=found.tau_C3)
    assert isinstance(found.a.mean, float)


@pytest.mark.parametrize("unloading", [Unloading.PUNCH, Unloading.PUNCH_EXACT])
def test_what_is_not_named_is_the_default_of_the_form(read, unloading):
    found = read("[a]\nsd = 0.3\n", unloading)
    assert found.effective_modulus_MPa == Priors.default(unloading).effective_modulus_MPa
    assert found.effective_modulus_MPa.median < 0.1 * Priors().effective_modulus_MPa.median
    assert Model(unloading).chosen_priors == Priors.default(unloading)
    assert Model(unloading, priors=found).chosen_priors == found


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[aa]\nmean = 1.0\n", ["aa", "Known priors", "effective_modulus_MPa"]),
        ("[a]\nmedian = 1.0\n", ["'a'", "median", "mean, sd"]),
        ("[tau_C1]\nmean = 1.0\n", ["tau_C1", "mean", "sd"]),
        ("[a]\nsd = -0.1\n", ["'a'", "the sd of a prior", "> 0", "-0.1"]),
        ("[tau_C1]\nsd = 0\n", ["tau_C1", "spread", "> 0"]),
        ("[tau_C3]\nshape = 0.6\n", ["tau_C3", "shape", "<= 0.5", "0.6"]),
        ("[tau_C3]\nshape = 0\n", ["tau_C3", "shape", "> 0", "0"]),
        ("[C1]\nmedian = -6.0\n", ["C1", "median", "> 0"]),
        ("[C1]\nlog_sd = nan\n", ["C1.log_sd", "finite number", "nan"]),
        ('[a]\nmean = "1.4"\n', ["'a'", "mean", "finite number", "1.4"]),
        ("[a]\nsd = true\n", ["a.sd", "finite number", "True"]),
        ("a = 1.4\n", ["'a'", "table", "[a]"]),
        ("[a\nmean = 1.0\n", ["TOML"]),
    ],
)
def test_a_mistake_is_told_with_file_and_entry(read, text, words):
    assert_holds(refusal(read, text), ["priors.toml", *words])


def test_json_holds_every_prior_with_its_numbers():
    priors = dataclasses.replace(Priors(), a=NormalPrior(1.4, 0.3))
    content = json.loads(json.dumps(priors.to_json(), allow_nan=False))
    assert set(content) == {f.name for f in dataclasses.fields(Priors)}
    assert content["a"] == {"distribution": "normal", "mean": 1.4, "sd": 0.3}
    assert content["C1"]["distribution"] == "log-normal"
    assert set(content["C1"]) == {"distribution", "median", "log_sd"}
    assert content["tau_C1"] == {"distribution": "nakagami", "sd": 0.5, "shape": 0.5}
