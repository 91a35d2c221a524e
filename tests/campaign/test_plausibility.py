"""Errors of unit, sign and column are named; sound campaigns of many solids are not accused."""

import functools
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers import SHARED
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax.calibrate.judgement import judged
from mcc_jax.campaign import (
    PAPER_DIAMETERS_UM,
    Campaign,
    Curve,
    check_plausibility,
    read_campaign,
    read_instrument_file,
    write_campaign,
)
from mcc_jax.simulate import Instrument, Programme, paper_campaign

PEBBLES, INSTRUMENTS = SHARED / "data" / "pebbles", SHARED / "data" / "testers"


def campaign(diameters, curves):
    names = tuple(f"P{i + 1}" for i in range(len(curves)))
    return Campaign(names, np.asarray(diameters, float), tuple(Curve(*curve) for curve in curves))


def press(diameters, modulus_MPa, hardness_MPa, strain, *, unloads=True, seconds=60.0, samples=300):
    """A sphere that is Hertz's at first and has a constant pressure in its contact later, unloaded elastically."""
    D1, D2, D3 = diameters
    diameter = D1 * D2 / D3
    radius, way = diameter / 2, np.linspace(0, strain * diameter, samples)
    elastic = 4 / 3 * modulus_MPa * 1e-3 * np.sqrt(radius) * (way[1:] / 2) ** 1.5
    plastic = hardness_MPa * 1e-3 * np.pi * radius * way[1:]
    force = np.concatenate([[0.0], (elastic**-3 + plastic**-3) ** (-1 / 3)])
    if unloads:
        back = min(1.5 * force[-1] / (modulus_MPa * 1e-3 * np.sqrt(radius * way[-1])), way[-1])
        share = np.linspace(1, 0, samples // 2)[1:]
        way, force = np.append(way, way[-1] - back * (1 - share)), np.append(force, force[-1] * share**1.5)
    return np.linspace(0, seconds, len(way)), force, way


def noisy(curve, rng, share=1e-3):
    time_s, *channels = curve
    return time_s, *(x + share * x.max() * rng.standard_normal(len(x)) for x in channels)


def cellulose(seed=0, count=20, *, unloads=True, stress_MPa=(7.0, 16.0), retreat=0.06):
    """The paper's particles under its mean law (eqs. 13 and 16).

    A share `retreat` of the displacement is given back: 0.13, 0.06 and 0.04 are 5, 11 and 16 GPa to the printed form
    of the law, and 0.5, 1 and 1.6 GPa to the slope of unloading.
    """
    rng = np.random.default_rng(seed)
    diameters = PAPER_DIAMETERS_UM[rng.permutation(20)[:count]]
    curves = []
    for D1, D2, D3 in diameters:
        diameter, eta = D1 * D2 / D3, 1 + 1.43 * (1 - D3**2 / (D1 * D2))
        x = np.linspace(0, 1.0, 2000)
        stress = np.exp(0.2 * rng.standard_normal()) * (7.0 * x - 27.2 * x**3 + 144 * x**5)
        stop = np.argmax(np.maximum.accumulate(stress) > rng.uniform(*stress_MPa))
        kept = np.linspace(0, stop, 200).astype(int)
        force, way = stress[kept] * np.pi * diameter**2 / 4 * 1e-3, x[kept] / eta * diameter
        if unloads:
            share = np.linspace(1, 0, 100)[1:]
            way = np.append(way, way[-1] * (1 - retreat * (1 - share)))
            force = np.append(force, force[-1] * share**1.5)
        curves.append(noisy((np.linspace(0, 300, len(way)), force, way), rng))
    return campaign(diameters, curves)


def ceramic(seed=0, count=12, *, unloads=True, modulus_MPa=1e5, force_mN=(1e4, 1e5), diameter_um=1000.0):
    """Elastic spheres of about one size, loaded to 10 to 100 N."""
    rng = np.random.default_rng(seed)
    diameters, curves = [], []
    for _ in range(count):
        size = diameter_um * np.exp(0.1 * rng.standard_normal()) * np.ones(3)
        peak = np.exp(rng.uniform(*np.log(force_mN)))
        own = modulus_MPa * np.exp(0.2 * rng.standard_normal())
        strain = 2 * (0.75 * peak / (own * 1e-3 * np.sqrt(size[0] / 2))) ** (2 / 3) / size[0]
        diameters.append(size)
        curves.append(noisy(press(size, own, 0.1 * own, strain, unloads=unloads), rng))
    return campaign(diameters, curves)


def slip(
    tests, *, force=1.0, displacement=1.0, seconds=1.0, diameters=(1, 1, 1), swap=False, order=(0, 1, 2), row=None
):
    """The campaign with a mistake, in all rows or in one."""
    curves, sizes = list(tests.curves), tests.diameters_um.copy()
    for i in range(len(tests)) if row is None else [row]:
        curve = curves[i]
        F, way = force * curve.force_mN, displacement * curve.displacement_um
        curves[i] = Curve(seconds * curve.time_s, *((way, F) if swap else (F, way)))
        sizes[i] = (sizes[i] * diameters)[list(order)]
    return replace(tests, curves=tuple(curves), diameters_um=sizes)


FORCES, DISPLACEMENTS, DIAMETERS = (
    f"The {what} seem 1000 times too" for what in ("forces", "displacements", "diameters")
)
SLIPS = {  # what goes wrong, the beginning of the sentence, what the remedy names
    "uN as mN": ({"force": 1e3}, f"{FORCES} large, as uN taken for mN", "force_uN"),
    "N as mN": ({"force": 1e-3}, f"{FORCES} small, as N taken for mN", "force_N"),
    "nm as um": ({"displacement": 1e3}, f"{DISPLACEMENTS} large, as nm taken for um", "displacement_nm"),
    "mm as um": ({"displacement": 1e-3}, f"{DISPLACEMENTS} small, as mm taken for um", "displacement_mm"),
    "diameters in mm": ({"diameters": (1e-3,) * 3}, f"{DIAMETERS} small", "D1_mm, D2_mm, D3_mm"),
    "diameters in nm": ({"diameters": (1e3,) * 3}, f"{DIAMETERS} large", "D1_nm, D2_nm, D3_nm"),
    "D3 in mm": ({"diameters": (1, 1, 1e-3)}, "The diameters D3 seem 1000 times too small", "D3_mm"),
    "N and mm": (
        {"force": 1e-3, "displacement": 1e-3, "diameters": (1e-3,) * 3},
        f"{FORCES} small.*displacements.*diameters",
        "force_N.*displacement_mm.*D1_mm",
    ),
    "swapped": ({"swap": True}, "Force and displacement seem to be swapped", "Exchange"),
    "forces negated": ({"force": -1}, "The forces of all tests .* wrong sign", "sign = -1 for force"),
    "displacements negated": ({"displacement": -1}, "The displacements of all tests .* wrong sign", "-1 for displacem"),
    "both negated": ({"force": -1, "displacement": -1}, "The forces and displacements of .* wrong", "force and disp"),
    "times in ms": ({"seconds": 1e3}, "The times seem 1000 times too large, as ms taken for s", "time_ms"),
}
EACH_SLIP = pytest.mark.parametrize("kind", SLIPS)
CAMPAIGNS = {
    "cellulose": cellulose,
    "cellulose, loading only": lambda seed: cellulose(seed, unloads=False),
    "ceramic": ceramic,
    "ceramic, loading only": lambda seed: ceramic(seed, unloads=False),
    "cellulose, 5 GPa": lambda seed: cellulose(7 + seed, count=5, retreat=0.13),
    "cellulose, 16 GPa": lambda seed: cellulose(7 + seed, count=5, retreat=0.04),
    "ceramic, 300 GPa, broken": lambda seed: ceramic(8 + seed, count=5, modulus_MPa=3e5, unloads=False),
    "small ceramic": lambda seed: ceramic(seed, diameter_um=60.0, force_mN=(30.0, 300.0), modulus_MPa=2e5),
    "one ceramic sphere": lambda seed: ceramic(seed, count=1),
    "one particle of cellulose": lambda seed: cellulose(seed, count=1),
}


@functools.cache
def made(name, seed):
    """A campaign of `CAMPAIGNS`; it is not to be changed."""
    return CAMPAIGNS[name](seed)


def accusing(findings):
    return [str(finding) for finding in findings if finding.level != "info"]


def says(findings, kind):
    _, sentence, remedy = SLIPS[kind]
    first = findings[0]
    return first.level == "error" and re.match(sentence, first.sentence) and re.search(remedy, first.remedy)


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_no_slip_no_accusation(name):
    for seed in range(10):
        assert not accusing(check_plausibility(made(name, seed)))


def test_a_wrong_unit_in_the_header_of_a_file_is_named(tmp_path):
    """Numbers in mN under `force_N`: the remedy holds whatever unit the file names."""
    write_campaign(ceramic(count=4), tmp_path)
    assert not accusing(check_plausibility(read_campaign(tmp_path)))
    file = tmp_path / "curves.csv"
    file.write_text(file.read_text().replace("force_mN", "force_N", 1))
    (finding,) = check_plausibility(read_campaign(tmp_path))
    assert finding.sentence.startswith("The forces seem 1000 times too large")
    assert "in place of another unit, take the one 1000 times smaller" in finding.remedy


@EACH_SLIP
@pytest.mark.parametrize("name", CAMPAIGNS)
def test_a_slip_is_named_with_its_column(name, kind):
    for seed in range(2):
        findings = check_plausibility(slip(made(name, seed), **SLIPS[kind][0]))
        assert len(findings) == 1, [str(finding) for finding in findings]
        assert says(findings, kind), str(findings[0])
        assert findings[0].particles == ()
        assert " or the " not in findings[0].sentence  # one slip only


@pytest.mark.parametrize("kind", [k for k in SLIPS if k != "times in ms"])
@pytest.mark.parametrize("make", [cellulose, ceramic])
def test_a_slip_in_one_row_names_the_particle(make, kind):
    findings = check_plausibility(slip(make(3), row=5, **SLIPS[kind][0]))
    assert [finding.particles for finding in findings] == [("P6",)]
    assert re.match(SLIPS[kind][1].replace("all tests", "particle P6"), findings[0].sentence)


@pytest.mark.parametrize("stress", [(4.0, 7.0), (7.0, 16.0)])
def test_radii_show_where_the_platens_would_have_touched(stress):
    for seed in range(4):
        findings = check_plausibility(slip(cellulose(seed, stress_MPa=stress), diameters=(0.5,) * 3))
        assert findings[0].sentence.startswith("The diameters seem to be radii")
        assert "twice" in findings[0].remedy


@pytest.mark.extended
@pytest.mark.parametrize("unloads", [True, False])
def test_forces_of_soft_tests_show_where_no_ductile_metal_is_so_strong(unloads):
    """3 to 4 GPa at a strain of 0.3 are beyond every metal that bears such a strain."""
    for seed in range(4):
        tests = cellulose(seed, unloads=unloads, stress_MPa=(3.0, 4.0))
        assert not accusing(check_plausibility(tests))
        (finding,) = check_plausibility(slip(tests, force=1e3))
        assert finding.sentence.startswith("The forces seem 1000 times too large, as uN taken for mN")


def test_radii_of_hard_spheres_cannot_show():
    """Half the size with 1.4 times the modulus is another sound sphere; nothing in the record contradicts it."""
    assert not accusing(check_plausibility(slip(ceramic(), diameters=(0.5,) * 3)))


@pytest.mark.parametrize(("order", "swapped"), [((2, 1, 0), "D1 and D3"), ((0, 2, 1), "D2 and D3")])
def test_a_diameter_in_the_place_of_d3(order, swapped):
    findings = check_plausibility(slip(cellulose(), order=order))
    assert [finding.sentence[:39] for finding in findings] == [f"The diameters {swapped} seem to be swap"]


def test_some_tests_of_another_instrument_are_listed():
    good, wrong = cellulose(1), slip(cellulose(1), force=1e3)
    mixed = replace(good, curves=(*wrong.curves[:8], *good.curves[8:]))
    (finding,) = check_plausibility(mixed)
    assert finding.sentence.startswith("The forces seem 1000 times too large")
    assert finding.particles == good.particles[:8]


def test_sign_and_unit_are_both_reported():
    first, second = check_plausibility(slip(ceramic(), force=-1e3))
    assert "wrong sign" in first.sentence
    assert "1000 times too large" in second.sentence


def test_another_material_is_reported_without_accusing_units():
    (finding,) = check_plausibility(ceramic())
    assert finding.level == "info"
    assert not re.search("unit|slip|wrong", str(finding))
    assert not check_plausibility(cellulose())


ACCUSES = re.compile(r"\bunits?\b|seem|slip|radi|swap|wrong|too (large|small)|[munk]N\b|mm\b|um\b")


@pytest.mark.parametrize("modulus", [1.6e10, 1e-3, 0.0, -5.0, np.nan, np.inf])
@pytest.mark.parametrize("name", ["cellulose", "ceramic", "ceramic, loading only"])
def test_a_fitted_modulus_of_no_solid_is_reported_and_accuses_no_unit(name, modulus):
    """A wrong unit moves it as it moves the stiffness of the record itself, so it is the fitted law that is wrong."""
    tests = made(name, 0)
    bad = [f for f in check_plausibility(tests, modulus_MPa=modulus) if f.level != "info"]
    assert [(f.check, f.level) for f in bad] == [("fitted modulus", "error")]
    assert not ACCUSES.search(str(bad[0]))
    assert not accusing(check_plausibility(tests, modulus_MPa=16e3))
    answer = {"converged": True, "effective_modulus_MPa": {"value": modulus, "sd": None}}
    assert bad == [f for f in judged(tests, answer, None, None) if f.level == "error"]  # as every method asks


@EACH_SLIP
def test_a_fitted_modulus_changes_nothing_of_a_slip(kind):
    tests = slip(made("ceramic", 0), **SLIPS[kind][0])
    assert check_plausibility(tests, modulus_MPa=3e7) == check_plausibility(tests)


SOLIDS = st.one_of(  # modulus [MPa], hardness / modulus, strain at the peak
    st.tuples(st.floats(6e2, 1e4), st.floats(0.02, 0.1), st.floats(0.035, 0.4)),
    st.tuples(st.floats(6e2, 3e4), st.floats(0.006, 0.05), st.floats(0.035, 0.4)),
    st.tuples(st.floats(2e4, 5e5), st.floats(0.04, 0.08), st.floats(0.002, 0.05)),
    st.tuples(st.floats(1.5e4, 3e5), st.floats(0.003, 0.015), st.floats(0.003, 0.4)),
)


@pytest.mark.extended
@settings(max_examples=100)
@given(
    SOLIDS,
    st.floats(20, 5000),
    st.floats(0.75, 1),
    st.integers(1, 8),
    st.booleans(),
    st.floats(1, 3000),
    st.integers(0, 99),
)
def test_sound_solids_of_many_kinds_and_sizes(solid, size, flatness, count, unloads, seconds, seed):
    modulus, ratio, strain = solid
    rng = np.random.default_rng(seed)
    diameters, curves = [], []
    for _ in range(count):
        own = size * np.exp(0.1 * rng.standard_normal()) * np.array([1, 1, flatness])
        diameters.append(own)
        curve = press(own, modulus, modulus * ratio, strain, unloads=unloads, seconds=seconds)
        curves.append(noisy(curve, rng))
    assert not accusing(check_plausibility(campaign(diameters, curves)))


@pytest.mark.extended
@settings(max_examples=8)
@given(
    st.lists(st.floats(0.03, 1.0), min_size=1, max_size=12),
    st.floats(0, 0.8),
    st.sampled_from([0.0, 20.0]),
    st.integers(0, 9),
)
def test_the_paper_s_material_is_itself_however_often_it_is_unloaded(levels, unload_to, hold_s, seed):
    programme = Programme.cycles(levels=(*levels, 1.0), unload_to=unload_to, hold_s=hold_s, points=600)
    instrument = Instrument(displacement_noise_um=0.05, force_noise_mN=0.05)
    tests = paper_campaign(seed, programme=programme, instrument=instrument)
    assert not check_plausibility(tests.select(np.arange(20) < 4))


NUMBERS = st.one_of(st.floats(-1e15, 1e15), st.sampled_from([0.0, 1e300, -1e300, 1e-300, np.nan, np.inf, -np.inf]))


@pytest.mark.extended
@settings(max_examples=100)
@given(st.integers(2, 30), st.integers(1, 5), st.data())
def test_nothing_makes_it_fail(samples, count, data):
    draw = lambda: np.array(data.draw(st.lists(NUMBERS, min_size=samples, max_size=samples)))  # noqa: E731
    curves = [(np.arange(samples) * 1.0, draw(), draw()) for _ in range(count)]
    sizes = np.array(data.draw(st.lists(NUMBERS, min_size=3 * count, max_size=3 * count))).reshape(count, 3)
    for finding in check_plausibility(campaign(sizes, curves)):
        assert "nan" not in str(finding)
        assert not finding.sentence.endswith(".")


def read_pebble(file):
    """Diameter [mm], and travel [mm] and force [N] of one record; None for a record without a diameter."""
    diameter, rows = None, []
    for line in file.read_text(encoding="latin-1").splitlines():
        cells = [cell.strip(' "') for cell in line.split("\t" if "\t" in line else ",")]
        if cells[0] == "Gage length":
            diameter = float(cells[1].replace(",", "."))
        elif len(cells) == 2 and re.match(r"-?[\d.,]+(e[-+]\d+)?$", cells[0]):
            rows.append([float(cell.replace(",", ".")) for cell in cells])
    return None if diameter is None or len(rows) < 10 else (diameter, np.array(rows))


@pytest.mark.skipif(not PEBBLES.is_dir(), reason="needs the measured pebbles next to the checkout")
@pytest.mark.parametrize(
    "folder", ["FZK_RT", "IPR_1mm", "IPR_batch3", "NFRI_1.5mm_RT", "NFRI_1mm_0.05mms", "NFRI_1mm_0.1mms"]
)
def test_measured_pebbles_are_not_accused_and_their_slips_are_named(folder):
    read = [read_pebble(file) for file in sorted((PEBBLES / folder).glob("*.TXT"))]
    read = [one for one in read if one is not None]
    tests = campaign(
        [[1e3 * diameter] * 3 for diameter, _ in read],
        [(1e-3 * np.arange(len(rows)), 1e3 * rows[:, 1], 1e3 * rows[:, 0]) for _, rows in read],
    )
    assert not accusing(check_plausibility(tests))
    for i in range(0, len(tests), 4):
        assert not accusing(check_plausibility(tests.select(np.arange(len(tests)) == i)))
    for kind in ("uN as mN", "N as mN", "nm as um", "mm as um", "diameters in mm", "swapped"):
        assert says(check_plausibility(slip(tests, **SLIPS[kind][0])), kind)


@pytest.mark.skipif(not INSTRUMENTS.is_dir(), reason="needs the measured indentations next to the checkout")
@pytest.mark.parametrize("name", ["Exp-50mN_0000.hld", "FS1.txt", "RobinSteel0000LC.txt", "multipleIndentations.zip"])
def test_indentations_with_a_made_up_diameter_are_not_accused(name):
    read = read_instrument_file(INSTRUMENTS / name, diameters_um=(200.0, 190.0, 180.0))
    for size in ((200.0, 190.0, 180.0), (50.0, 50.0, 50.0), (100.0, 100.0, 100.0), (500.0, 500.0, 500.0)):
        tests = replace(read, diameters_um=np.tile(size, (len(read), 1)))
        assert not accusing(check_plausibility(tests))
        for i in range(0, len(tests), 8):
            assert not accusing(check_plausibility(tests.select(np.arange(len(tests)) == i)))
        # The printed form of the law finds 4 to 150 TPa in them, which no unit explains.
        found = check_plausibility(tests, modulus_MPa=3e7)
        assert [f.check for f in found if f.level != "info"] == ["fitted modulus"]
        assert not ACCUSES.search(str(found[0]))
