"""What a campaign holds cannot be changed: what was found of it is kept with it."""

import numpy as np
import pytest

from mcc_jax._archive import encode, read_archive
from mcc_jax.campaign import Campaign, Curve


def a_campaign():
    steps = np.arange(4.0)
    return steps, Campaign(("1",), np.array([[3.0, 2.0, 1.0]]), (Curve(steps, 2 * steps, 0.1 * steps),))


def test_its_arrays_cannot_be_written_to(tmp_path):
    given, campaign = a_campaign()
    (tmp_path / "campaign.msgpack").write_bytes(encode(campaign))
    for one in (campaign, read_archive(tmp_path / "campaign.msgpack")):
        curve = one.curves[0]
        for array in (one.diameters_um, curve.time_s, curve.force_mN, curve.displacement_um):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 7.0
    given[1] = 9.0  # the caller's own stays free
    assert campaign.curves[0].time_s[1] == 1.0
