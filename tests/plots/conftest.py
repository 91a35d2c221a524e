from dataclasses import replace

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


def repeated(calibration, count):
    """A calibration of so many particles, those of another over and over: nothing new to compile."""

    def again(values):
        return tuple(values[i % len(values)] for i in range(count))

    campaign, adjustment = calibration.campaign, calibration.adjustment
    index = np.arange(count) % len(campaign)
    table = calibration.table
    return replace(
        calibration,
        campaign=replace(
            campaign,
            particles=tuple(str(i + 1) for i in range(count)),
            diameters_um=campaign.diameters_um[index],
            curves=again(campaign.curves),
            columns={},
        ),
        adjustment=replace(
            adjustment,
            curves=again(adjustment.curves),
            shift=adjustment.shift[index],
            reasons=again(adjustment.reasons),
            segments=again(adjustment.segments),
        ),
        table=replace(
            table,
            strain=table.strain[index],
            reached=table.reached[index],
            flatness=table.flatness[index],
            index=np.arange(count),
        ),
        particles=again(calibration.particles),
    )


@pytest.fixture(scope="session")
def campaigns():
    cycles = Programme.cycles(levels=(0.3, 0.6, 1.0), unload_to=0.1, hold_s=20.0, interval_s=4.0)
    return {
        "paper": paper_campaign(0),
        "cycles": paper_campaign(1, programme=cycles).select(np.arange(20) % 3 == 0),
        "two": resampled([8.0, 12.0]),
        "dropped": resampled([8.0, 0.1, 12.0, 9.0, 0.15, 10.0, 7.0, 0.05, 14.0], ODD_NAMES, seed=1),
    }


class Calibrations(dict):
    """Each campaign is calibrated where it is first asked for: every number of particles compiles anew."""

    def __init__(self, campaigns):
        super().__init__()
        self.campaigns = campaigns

    def __missing__(self, name):
        found = repeated(self["paper"], 23) if name == "many" else calibrate_paper(self.campaigns[name])
        self[name] = found
        return found


@pytest.fixture(scope="session")
def calibrations(campaigns):
    return Calibrations(campaigns)
