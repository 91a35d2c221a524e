"""What was found of a test is kept with it until a reading changes."""

import numpy as np

import mcc_jax as mcc
from mcc_jax.campaign.memory import remembered


def test_it_is_found_once_and_anew_once_a_reading_has_changed():
    curve = mcc.paper_campaign(0).curves[0]
    asked: list[float] = []

    def largest() -> float:
        asked.append(float(np.max(curve.force_mN)))
        return asked[-1]

    first = remembered(curve, "largest", largest)
    assert remembered(curve, "largest", largest) == first
    assert len(asked) == 1
    assert remembered(curve, ("largest", 2), largest) == first
    assert len(asked) == 2
    curve.force_mN[3] = 2 * first
    assert remembered(curve, "largest", largest) == 2 * first
    assert len(asked) == 3
