import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax import Hold, InputError, Programme, Ramp
from mcc_jax.simulate import read_programme


def test_levels_holds_and_partial_unloads_are_all_reached():
    programme = Programme.cycles(rate=4.0, levels=(0.5, 1.0), unload_to=0.1, hold_s=10.0, interval_s=1.0)
    time, force = programme.sample(80.0)
    turning = {0.0: 0.0, 10.0: 40.0, 20.0: 40.0, 28.0: 8.0, 46.0: 80.0, 56.0: 80.0, 76.0: 0.0}
    for t, f in turning.items():
        assert force[np.argmin(np.abs(time - t))] == pytest.approx(f)
    assert time[-1] == pytest.approx(76.0)


steps = st.lists(
    st.one_of(
        st.builds(Ramp, st.one_of(st.just(0.0), st.floats(1e-6, 2)), st.floats(0.01, 100)),
        st.builds(Hold, st.floats(0.01, 100)),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=100)
@given(steps, st.floats(1, 1e3), st.integers(2, 500))
def test_sampled_paths_increase_in_time_and_stay_within_the_levels(steps, peak, points):
    programme = Programme("load", tuple(steps), points=points)
    if not any(isinstance(s, Hold) or s.to > 0 for s in steps):
        with pytest.raises(ValueError, match="never leaves zero"):
            programme.sample(peak)
        return
    time, value = programme.sample(peak)
    ramps = [s for s in steps if isinstance(s, Ramp)]
    assert (np.diff(time) > 0).all()
    assert value.min() >= 0
    assert value.max() == pytest.approx(max([0.0, *(s.to * peak for s in ramps)]))
    fastest = max([0.0, *(s.rate for s in ramps)])
    assert np.abs(np.diff(value) / np.diff(time)).max() <= fastest * (1 + 1e-6) + 1e-9


def test_a_ramp_of_less_than_a_picosecond_is_none():
    with pytest.raises(ValueError, match="never leaves zero"):
        Programme("load", (Ramp(5e-324, 1.0),), points=2).sample(1.0)
    time, value = Programme("load", (Ramp(5e-324, 1.0), Ramp(1.0, 1.0)), points=3).sample(1.0)
    np.testing.assert_allclose(time, [0, 0.5, 1])
    np.testing.assert_allclose(value, [0, 0.5, 1])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Programme("load", steps=(Ramp(1.0, 1.0),)), "exactly one of"),
        (lambda: Programme("load", steps=(Ramp(1.0, 1.0),), points=10, interval_s=1.0), "exactly one of"),
        (lambda: Programme("load", steps=(), points=10), "at least one step"),
        (lambda: Programme("load", steps=(Ramp(1.0, 1.0),), points=1), "points"),
        (lambda: Ramp(1.0, 0.0), "rate"),
        (lambda: Ramp(-1.0, 1.0), "level"),
        (lambda: Hold(0.0), "hold"),
    ],
)
def test_impossible_programmes_and_steps_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_programme_file_round_trip(tmp_path):
    file = tmp_path / "programme.toml"
    steps = "[[step]]\nramp_to = 1\n[[step]]\nhold_s = 60\n[[step]]\nramp_to = 0\nrate = 4.0\n"
    file.write_text(f'control = "load"\nrate = 2\ninterval_s = 0.5\n{steps}')
    assert read_programme(file) == Programme("load", (Ramp(1.0, 2.0), Hold(60.0), Ramp(0.0, 4.0)), interval_s=0.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("control = ", "not TOML"),
        ("rate = 2", "no [[step]]"),
        ("speed = 2\n[[step]]\nramp_to=1", "unknown entry 'speed'"),
        ("[[step]]\nramp_to = 1", "rate, of the step or of all at the top, must be"),
        ("rate=1\n[[step]]\nramp_to = 'full'", "must be a finite number"),
        ("rate=1\n[[step]]\nramp_to = 1\nhold_s = 2", "step 1: must have ramp_to"),
        ("rate=1\n[[step]]\nramp_to = 1\n[[step]]\nhold_s = 1\nfast = true", "step 2: must have ramp_to"),
        ("rate=-1\n[[step]]\nramp_to = 1", "rate"),
        ("rate=1\npoints=2.5\n[[step]]\nramp_to = 1", "whole number"),
        ("control='torque'\nrate=1\n[[step]]\nramp_to = 1", "control"),
        ("step = 3", "no [[step]]"),
        ("rate=true\n[[step]]\nramp_to = 1", "must be a finite number"),
    ],
)
def test_bad_programme_files_are_refused_in_one_line(tmp_path, text, message):
    file = tmp_path / "programme.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=rf"programme\.toml.*{re.escape(message)}"):
        read_programme(file)
