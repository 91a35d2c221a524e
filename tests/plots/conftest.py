import functools

import jax
import numpy as np
import pytest

from mcc_jax.calibrate import calibrate_paper
from mcc_jax.campaign import PAPER_DIAMETERS_UM
from mcc_jax.simulate import (
    Instrument,
    Programme,
    law_for_each,
    paper_campaign,
    paper_population,
    simulate_campaign,
)

ODD_NAMES = (
    "$x_1$ <script>",
    "a_b^c",
    "very long name of a particle from the second batch of 2024",
    "tab\tnew\nline",
    "$",
    "中文粒子",
    "\\frac{1}{0}",
    "100 % & #5",
    "{}",
)


def resampled(stresses, names=None, *, seed=0, points=100):
    """Particles with sizes drawn from the paper's table, one cycle to the given peak stresses."""
    n = len(stresses)
    rng = np.random.default_rng(seed)
    diameters = PAPER_DIAMETERS_UM[rng.integers(0, 20, n)] * rng.uniform(0.9, 1.1, (n, 3))
    laws = law_for_each(paper_population().sample(jax.random.key(seed), n), 1.43, 16000.0)
    D1, D2, D3 = diameters.T
    peaks = np.asarray(stresses) * np.pi / 4 * (D1 * D2 / D3) ** 2 * 1e-3
    instrument = Instrument(displacement_noise_um=0.05, force_noise_mN=0.02, zero_um=2.0)
    programme = Programme.cycles(points=points)
    return simulate_campaign(laws, diameters, peaks, programme, instrument=instrument, particles=names, seed=seed)


@pytest.fixture(scope="session")
def campaigns():
    cycles = Programme.cycles(levels=(0.3, 0.6, 1.0), unload_to=0.1, hold_s=20.0, interval_s=4.0)
    return {
        "paper": paper_campaign(0),
        "cycles": paper_campaign(1, programme=cycles).select(np.arange(20) % 3 == 0),
        "two": resampled([8.0, 12.0]),
        "dropped": resampled([8.0, 0.1, 12.0, 9.0, 0.15, 10.0, 7.0, 0.05, 14.0], ODD_NAMES, seed=1),
    }


@pytest.fixture(scope="session")
def calibrated(campaigns):
    """The paper's calibration of a campaign by its name, made where it is first asked for."""
    return functools.cache(lambda name: calibrate_paper(campaigns[name]))
