"""Campaigns joined: every test once, nothing lost, nothing mixed that is not alike."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mcc_jax import InputError
from mcc_jax.campaign import Campaign, Curve, Metadata, check_campaign, join_campaigns, read_campaign, write_campaign


def campaign(names, seed, **metadata):
    rng = np.random.default_rng(seed)
    curves = tuple(
        Curve(np.arange(5.0 + i), np.sort(rng.uniform(0, 9, 5 + i)), np.sort(rng.uniform(0, 9, 5 + i)))
        for i in range(len(names))
    )
    moist = {"relative_humidity_percent": tuple(f"{10 * (seed + i)}" for i in range(len(names)))}
    return Campaign(tuple(names), rng.uniform(50, 99, (len(names), 3)), curves, moist, Metadata(**metadata), f"c{seed}")


def test_every_test_is_there_once_in_order(tmp_path):
    parts = [campaign("ab", 1), campaign("cde", 2), campaign("f", 3)]
    joined = join_campaigns(*parts)
    assert joined.particles == tuple("abcdef")
    assert joined.columns["relative_humidity_percent"] == ("10", "20", "20", "30", "40", "30")
    for part in parts:
        again = joined.select(np.isin(joined.particles, part.particles))
        np.testing.assert_array_equal(again.diameters_um, part.diameters_um)
        assert again.curves == part.curves
    check_campaign(joined, file="joined")
    write_campaign(joined, tmp_path / "joined")
    np.testing.assert_allclose(read_campaign(tmp_path / "joined").diameters_um, joined.diameters_um)


def test_what_is_known_of_the_tests_is_kept():
    one = campaign(
        "a", 1, control="load", force_resolution_mN=0.01, provenance="lab", other={"operator": "x", "kept": 1}
    )
    two = campaign(
        "b", 2, control="load", force_resolution_mN=0.02, provenance="attic", other={"operator": "y", "new": 2}
    )
    joined = join_campaigns(one, two).metadata
    assert joined.control == "load"
    assert joined.force_resolution_mN == 0.02
    assert joined.displacement_resolution_um is None
    assert joined.provenance == "lab; attic"
    assert joined.other == {"operator": "x", "kept": 1, "new": 2}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"particles": ("b",)}, "c1, c2: the particle 'b' appears 2 times"),
        ({"columns": {}}, "c2: columns is [] here and ['relative_humidity_percent']"),
        ({"metadata": Metadata(control="displacement")}, "c2: control is 'displacement' here and 'load'"),
        ({"metadata": Metadata(control="load", punch_diameter_um=50.0)}, "c2: punch_diameter_um is 50.0 here and None"),
        ({"metadata": Metadata(control="load", corrections=("frame",))}, "c2: corrections is"),
    ],
)
def test_what_is_not_alike_is_refused(change, told):
    one, two = campaign("ab", 1, control="load"), campaign("c", 2, control="load")
    with pytest.raises(InputError, match=re.escape(told)):
        join_campaigns(one, replace(two, **change))
