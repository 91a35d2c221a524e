"""What a campaign holds, by name, in order and as a table; it cannot be changed: what was found of it is kept."""

import numpy as np
import pandas as pd
import pytest

from mcc_jax import InputError
from mcc_jax._archive import encode, read_archive
from mcc_jax.campaign import Campaign, Curve, write_campaign


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


def test_tests_by_name_in_order_and_as_a_table(tmp_path):
    curves = [Curve(np.arange(2.0 + i), np.arange(1.0, 3 + i), 0.1 * np.arange(1.0, 3 + i)) for i in range(3)]
    campaign = Campaign(["P1", "01", "P3"], np.ones((3, 3)), curves)
    assert campaign["01"] is curves[1]
    assert "01" in campaign
    assert "1" not in campaign
    assert [len(test) for test in campaign] == [2, 3, 4]
    with pytest.raises(InputError, match=r"there is no particle 'P2'\. There are: P1, 01, P3"):
        campaign["P2"]
    write_campaign(campaign, tmp_path / "c")
    file = pd.read_csv(tmp_path / "c" / "curves.csv", dtype={"particle": str})
    pd.testing.assert_frame_equal(campaign.to_dataframe().astype({"particle": file["particle"].dtype}), file)
