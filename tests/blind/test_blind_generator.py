"""The generator of the blind test: its law against numbers computed elsewhere, its noise, strengths and files."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.blind.generator import campaigns, designs, effects, law, noise, strength, tiers
from mcc_jax.campaign import find_segments, read_campaign

ROOT = Path(__file__).parents[2]
MEAN = {"C1": 7.0094, "C3": 27.235 ** (1 / 3), "C5": 144.23**0.2}  # the printed mean law


def mean_particles(rows, modulus=16_000.0, **changes):
    D = np.atleast_2d(np.asarray(rows, dtype=float))
    full = {name: np.full(len(D), value) for name, value in {**MEAN, **changes}.items()}
    return law.Particles(*D.T, **full, modulus=np.full(len(D), modulus), zero=np.zeros(len(D)))


def cycle(particles, peak_mpa, fractions):
    """A path through the given fractions of the peak stress, two samples a leg."""
    force = peak_mpa * np.pi * particles.De[:, None] ** 2 / 4 * 1e-3 * np.asarray(fractions)
    zeros = np.zeros_like(force)
    return designs.Path(np.cumsum(np.ones_like(force), axis=1), force, zeros, zeros > 0, zeros, zeros, zeros, zeros > 0)


def small(protocol="P1", seed=0, count=5, humidity=True):
    rng = np.random.default_rng(seed)
    particles = designs.population(rng, designs.TABLE_1[:count], humidity=humidity)
    return particles, designs.programme(rng, particles, protocol)


# --- the law ---------------------------------------------------------------------------------------------------------
def test_shape_and_size_of_the_paper():
    particles = mean_particles(designs.TABLE_1)
    assert particles.De[[0, 5, 11, 15]] == pytest.approx(
        [224.702344228, 135.70384106, 187.299122332, 361.033753754], rel=1e-11
    )
    eta = law.shape_factor(particles.q)
    assert eta[[0, 5, 11, 15]] == pytest.approx([1.24420062209, 1.87308503422, 1.41395466231, 1.55948471789], rel=1e-11)


def test_master_curve_and_its_inverse():
    x = np.array([0.01, 0.1, 0.3, 0.5, 0.6])
    stress = law.master_stress(x, **MEAN)
    assert stress == pytest.approx([0.070066779423, 0.6751473, 1.7179539, 4.6075125, 9.5382048], rel=1e-7)
    back = law.first_strain(stress[None, :], lambda x: law.master_stress(x, **MEAN))
    assert back[0] == pytest.approx(x, rel=1e-12)
    assert law.first_strain(np.array([[1.0, 10.0]]), lambda x: law.master_stress(x, **MEAN))[0] == pytest.approx(
        [0.1553771180449241, 0.6063483028158896], rel=1e-12
    )


@pytest.mark.parametrize(
    ("row", "peak", "strain", "recovered"),
    [
        ((100.0, 100.0, 100.0), 10.0, 0.606348302816, 0.0158172259104),
        (designs.TABLE_1[0], 7.0, 0.448764815105, 0.0153826451248),
        (designs.TABLE_1[0], 16.0, 0.538652047060, 0.0212274210671),
        (designs.TABLE_1[11], 10.0, 0.428831502862, 0.0188082357440),
        (designs.TABLE_1[15], 16.0, 0.429751702184, 0.0237652610522),
    ],
)
def test_peak_and_recovery(row, peak, strain, recovered):
    particles = mean_particles(row)
    gamma = law.simulate(particles, cycle(particles, peak, [0.5, 1.0, 0.391002218956, 1e-15]))
    eps = gamma[0] / particles.De[0]
    assert eps[1] == pytest.approx(strain, rel=1e-10)
    assert eps[1] - eps[2] == pytest.approx(0.5 * recovered, rel=1e-9)
    assert eps[1] - eps[3] == pytest.approx(recovered, rel=1e-8)


def test_recovered_fraction_against_the_table_and_back():
    ratio = np.array([0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99])
    expected = [0.95873500358708, 0.80538363652012, 0.63470459397619, 0.40397275329952]
    expected += [0.19764395315566, 0.078620887418228, 0.0078540623827244]
    assert law.recovered_fraction(ratio) == pytest.approx(expected, rel=1e-12)
    fine = np.linspace(0.0, 1.0, 1001)
    assert law.unloading_ratio(law.recovered_fraction(fine)) == pytest.approx(fine, abs=1e-13)


def test_snap_through_takes_the_running_maximum():
    C = {"C1": 4.0, "C3": 3.0, "C5": 2.4}
    peak, trough = 0.664820461376, 0.660463146397
    assert not law.is_monotone(**C)
    stress = np.array([[peak - 1e-5, peak + 1e-7]])
    x = law.first_strain(stress, lambda x: law.master_stress(x, **C))[0]
    assert x[0] < 0.290470885402 < 0.345075622969 < x[1]
    assert law.master_stress(x, **C) == pytest.approx(stress[0], rel=1e-10)
    assert (law.first_strain(np.array([[trough]]), lambda x: law.master_stress(x, **C)) < 0.2905).all()


def test_reload_retraces_and_load_beyond_the_peak_forgets():
    particles = mean_particles(designs.TABLE_1[:4])
    there = law.simulate(particles, cycle(particles, 10.0, [0.2, 0.6, 0.3, 0.45, 0.3, 0.6, 1.0]))
    straight = law.simulate(particles, cycle(particles, 10.0, [0.2, 0.6, 1.0]))
    assert there[:, 2] == pytest.approx(there[:, 4], rel=1e-14)
    assert there[:, -1] == pytest.approx(straight[:, -1], rel=1e-14)


@given(st.floats(0.3, 3.0))
@settings(max_examples=20)
def test_only_shape_and_ratio_matter(scale):
    rows = designs.TABLE_1[:3]
    one, other = mean_particles(rows), mean_particles(scale * rows)
    fractions = [0.3, 1.0, 0.5, 0.1]
    assert law.simulate(other, cycle(other, 9.0, fractions)) == pytest.approx(
        scale * law.simulate(one, cycle(one, 9.0, fractions)), rel=1e-12
    )


# --- designs and noise -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("protocol", designs.PROTOCOLS)
def test_programmes(protocol):
    particles, path = small(protocol, count=6)
    assert path.force.shape == path.time.shape == (6, designs.POINTS)
    assert (np.diff(path.time, axis=1) > 0).all()
    assert (path.force > 0).all()
    peak = path.force.max(axis=1) / (np.pi * particles.De**2 / 4 * 1e-3)
    assert ((peak >= 7) & (peak <= 16)).all()
    rate = np.abs(np.diff(path.force, axis=1) / np.diff(path.time, axis=1))
    moving = rate > 1e-6
    wanted = np.where(np.arange(6)[:, None] % 2, 20.0 if protocol == "P2" else 2.0, 2.0)
    assert rate[moving] == pytest.approx(np.broadcast_to(wanted, rate.shape)[moving], rel=1e-9)
    still = (np.diff(path.time, axis=1) * ~moving).sum(axis=1)
    assert still == pytest.approx(0.0 if protocol == "P0" else designs.HOLD_S)
    assert path.reload.any() == (protocol != "P0")
    assert path.reloads.max() == (0 if protocol == "P0" else 2)


def test_population_follows_table_2():
    rng = np.random.default_rng(3)
    particles = designs.population(rng, np.repeat(designs.TABLE_1, 200, axis=0))
    # Nearly non-monotone draws are replaced, which moves the means by about 0.01: what an answer calls true.
    moved = law.monotone_means(designs.MARGIN)
    assert abs(moved[0] - law.LOG_C["C1"][0]) > 0.01
    for (name, (_, sd)), mean in zip(law.LOG_C.items(), moved, strict=True):
        logs = np.log(getattr(particles, name))
        assert logs.mean() == pytest.approx(mean, abs=1e-9 + 4 * sd / 63)
        assert logs.std() == pytest.approx(sd, rel=0.1)
    assert law.is_monotone(particles.C1, particles.C3, particles.C5).all()
    jumping = designs.population(rng, designs.TABLE_1, snap_through=True)
    assert 1 <= (~law.is_monotone(jumping.C1, jumping.C3, jumping.C5)).sum() <= 2


@pytest.mark.parametrize("heavy", [False, True])
def test_noise_has_its_covariance(heavy):
    particles, path = small("P0", count=1)
    length = np.repeat(noise.path_length(particles, path)[:, ::20], 40_000, axis=0)
    kind = noise.Noise(heavy_tails=heavy, ou_length_mpa=2.0)
    scale = np.full(len(length), 1.5)
    drawn, force = noise.draw(np.random.default_rng(0), kind, length, scale)
    expected = noise.covariance(kind, length[:1], scale[:1], np.zeros((1, 1)))[0]
    assert np.cov(drawn.T) == pytest.approx(expected, abs=(0.25 if heavy else 0.03) * expected.max())
    assert force.std() == pytest.approx(kind.force_mN, rel=0.01)
    white = drawn[:, 0] if not heavy else np.diff(drawn, axis=1).ravel()
    kurtosis = np.mean((white - white.mean()) ** 4) / white.var() ** 2
    assert (kurtosis > 3.3) == heavy


def test_force_noise_acts_through_the_slope():
    kind = noise.Noise(white_um=0.0, ou_um=0.0, force_mN=0.1)
    total = noise.covariance(kind, np.zeros((1, 3)), np.ones(1), np.array([[1.0, 2.0, 0.0]]))
    assert total[0] == pytest.approx(np.diag([0.01, 0.04, 0.0]))


# --- effects ---------------------------------------------------------------------------------------------------------
ALL = (*effects.LISTED, *effects.UNLISTED)


def names(form):
    return f"{form.mechanism}-{form.form}"


@pytest.mark.parametrize("form", ALL, ids=names)
def test_nothing_is_left_at_null_and_something_is_there_beyond(form):
    particles, path = small("P2")
    effect = effects.Effect(form, form.draw(np.random.default_rng(1), 5), form.signs[-1])
    base = law.simulate(particles, path)
    assert law.simulate(particles, path, effect(0.0)) == pytest.approx(base, abs=1e-11)
    changed = law.simulate(particles, path, effect(form.unit)) - base
    assert np.isfinite(changed).all()
    assert np.abs(changed).max() > 1e-3


@pytest.mark.parametrize("name", ["reload_hysteresis", "ratcheting"])
def test_without_reload_nothing_of_it_shows(name):
    particles, path = small("P0")
    base = law.simulate(particles, path)
    for form in (effects.EXACT[name], *effects.VARIANTS[name]):
        assert (law.simulate(particles, path, effects.Effect(form)(form.unit)) == base).all()


def test_effects_of_known_size():
    particles, path = small("P1")
    base = law.simulate(particles, path)

    def changed(name, amplitude, **circumstances):
        return law.simulate(particles, path, effects.Effect(effects.EXACT[name], circumstances)(amplitude)) - base

    assert changed("frame_compliance", 2e-3) == pytest.approx(2e-3 * path.force)
    assert changed("thermal_drift", 1e-3) == pytest.approx(1e-3 * path.time)
    # Long after a step of stress a Kelvin-Voigt element has crept to compliance times stress.
    creep = changed("creep", 1e-4, tau=1e-3) / particles.De[:, None]
    stress = path.force / (np.pi * particles.De[:, None] ** 2 / 4 * 1e-3)
    assert creep[:, 1:] == pytest.approx(1e-4 * (stress - stress[:, :1])[:, 1:], abs=1e-12)
    # Adhesion leaves more displacement, reverse plasticity less, and neither touches the loading.
    adhesion, reverse = changed("adhesion", 0.5), changed("reverse_plasticity", 1e-3)
    assert (adhesion[:, -1] > 0).all()
    assert reverse[:, -1] == pytest.approx(-1e-3 * particles.De * (1 - path.force[:, -1] / path.force.max(axis=1)) ** 4)
    top = path.force == path.force.max(axis=1, keepdims=True)
    assert np.abs(adhesion[top]).max() < 1e-10
    assert np.abs(reverse[top]).max() < 1e-10
    # A hysteretic reload lies on the side of less displacement, as a loop that dissipates must.
    lag = changed("reload_hysteresis", 0.1)
    assert (lag <= 0).all()
    assert (lag[~path.reload] == 0).all()


def test_forms_are_complete():
    assert len(effects.MECHANISMS) == 20
    assert set(effects.EXACT) == set(effects.MECHANISMS)
    assert all(effects.VARIANTS[name] for name in effects.MECHANISMS)
    assert len(effects.UNLISTED) == 12
    assert not set(effects.MECHANISMS) & {form.mechanism for form in effects.UNLISTED}
    assert len(tiers.PAIRS) == 30
    assert {name for pair in (*tiers.PAIRS, *tiers.TWINS) for name in pair} <= set(effects.MECHANISMS)


# --- strength --------------------------------------------------------------------------------------------------------
def test_lambda_is_the_estimate_over_its_standard_error():
    # The same number from the information matrix of one explicit regression: effect, globals and every random effect.
    particles, path = small("P1", count=4)
    projection = strength.Projection(particles, path, noise.CLEAN, np.ones(4))
    signature = path.force
    columns = strength._tangents(particles, path, law.SHAPE_PARAMETER)
    n, m = path.force.shape
    X = np.stack([columns[k].ravel() for k in ("a", "modulus", "C1", "C3", "C5")], axis=1)
    Z = np.zeros((n * m, 3 * n))
    for i in range(n):
        for j, column in enumerate((columns["C1"][i], columns["C5"][i], np.ones(m))):
            Z[i * m : (i + 1) * m, 3 * i + j] = column
    steps = np.gradient(path.force, axis=1)
    slope = np.gradient(projection.base, axis=1) / np.where(steps == 0, np.inf, steps)
    K = noise.covariance(noise.CLEAN, noise.path_length(particles, path), np.ones(n), np.clip(np.abs(slope), 0, 5))
    prior = np.concatenate([np.zeros(6), np.tile([1 / 0.2985**2, 1 / 0.0797**2, 1e-2], n)])
    design = np.concatenate([signature.reshape(-1, 1), X, Z], axis=1)
    weighted = np.concatenate([np.linalg.solve(K[i], design[i * m : (i + 1) * m]) for i in range(n)])
    information = design.T @ weighted + np.diag(prior)
    scale = 1 / np.sqrt(np.diag(information))
    error = np.sqrt(np.linalg.inv(information * np.outer(scale, scale))[0, 0]) * scale[0]
    assert projection.strength(effects.Effect(effects.EXACT["frame_compliance"])(1e-3)) == pytest.approx(
        1e-3 / error, rel=1e-3
    )


def test_what_the_base_law_takes_up_is_not_left_unexplained():
    """The change less its best fit by tangents, which are weighed as the strength weighs them."""
    particles, path = small("P1")
    projection = strength.Projection(particles, path, noise.CLEAN, np.ones(5))
    columns = strength._tangents(particles, path, law.SHAPE_PARAMETER)
    change = 1e-3 * path.force
    left = projection.unexplained(change)
    np.testing.assert_allclose(projection.unexplained(change + 0.3 * columns["modulus"]), left, atol=1e-7)
    own = np.zeros_like(change)
    own[2] = 0.1 * columns["C1"][2] + 0.5
    taken = projection.unexplained(own)
    assert np.abs(taken).max() < 0.15 * np.abs(own).max()
    assert 0.01 < np.abs(left).max() < np.abs(change).max()
    np.testing.assert_allclose(projection.unexplained(2 * change), 2 * left, rtol=1e-9, atol=1e-12)


def test_what_the_base_law_can_take_up_has_no_strength():
    particles, path = small("P1")
    projection = strength.Projection(particles, path, noise.CLEAN, np.ones(5))
    rounder = law.simulate(particles.with_(modulus=particles.modulus * 1.3, C1=particles.C1 * 1.3), path, a=1.8)
    assert np.linalg.norm(projection.project(rounder - projection.base)) > 1.0  # straight tangents do not follow
    assert projection.refit(rounder, rounds=8) < 0.1


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.long if i % 4 else ()) for i, name in enumerate(effects.MECHANISMS)],
)
def test_lambda_is_hit(name):
    case = tiers.Case(f"hit-{name}", "T1", name, "P1", count=10, effects=((name, "exact", 8.0),), humidity=True)
    if name == "size_effect":
        case = tiers.Case(f"hit-{name}", "T1", name, "P1", count=60, resample=True, effects=((name, "exact", 3.0),))
    built = campaigns.build(case, 11)
    (effect,) = built.answer["effects"]
    assert effect["lambda"] == pytest.approx(effect["lambda_target"], rel=0.05)
    if name != "pop_in":
        assert abs(built.answer["oracle"]["statistics"][name]) > 0.5 * effect["lambda"]


def test_strength_of_struck_and_unlisted_effects_counts_what_is_left():
    unlisted = tiers.Case(
        "u", "T4", "drive_backlash", "P1", effects=(("drive_backlash", "unlisted", 10.0),), residual=True
    )
    (effect,) = campaigns.build(unlisted, 1).answer["effects"]
    assert effect["lambda_residual"] == pytest.approx(10.0, rel=0.05)
    assert effect["lambda"] > effect["lambda_residual"] > effect["lambda_outside_span"] > 0


# --- files -----------------------------------------------------------------------------------------------------------
def files(folder):
    return [(folder / name).read_bytes() for name in ("particles.csv", "curves.csv", "campaign.toml")]


def test_same_seed_same_files(tmp_path):
    case = tiers.Case(
        "c", "T1", "creep", "P1", count=4, resample=True, effects=(("creep", "exact", 10.0),), humidity=True
    )
    again = tiers.from_record(case.record())
    digests = [
        campaigns.write(campaigns.build(c, s), tmp_path / str(k))
        for k, (c, s) in enumerate([(case, 5), (again, 5), (case, 6)])
    ]
    assert digests[0] == digests[1] != digests[2]
    assert files(tmp_path / "0") == files(tmp_path / "1")


@pytest.mark.parametrize("protocol", designs.PROTOCOLS)
def test_the_library_reads_the_files(tmp_path, protocol):
    case = tiers.Case("v", "T0", "clean", protocol, count=6, resample=True, humidity=True)
    built = campaigns.build(case, 2)
    campaigns.write(built, tmp_path)
    read = read_campaign(tmp_path)
    assert len(read.curves) == 6
    assert read.metadata.control == "load"
    header = (tmp_path / "particles.csv").read_text().splitlines()[0]
    assert header == "particle,D1_um,D2_um,D3_um,batch,relative_humidity_percent"
    curve = read.curves[0]
    assert np.asarray(curve.force_mN) == pytest.approx(built.force[0], abs=1e-5)
    assert np.asarray(curve.displacement_um) == pytest.approx(built.displacement[0], abs=1e-5)
    assert len(find_segments(curve)) >= (2 if protocol == "P0" else 6)


def test_null_is_base_law_and_noise():
    case = tiers.Case("n", "T0", "clean", "P1")
    built = campaigns.build(case, 4)
    drawn, _ = campaigns.design(case, 4)
    left = built.displacement - law.simulate(drawn.particles, drawn.path)
    assert left.std() == pytest.approx(np.hypot(0.03, 0.10), rel=0.1)
    assert built.answer["effects"] == []


def test_hidden_columns_stay_hidden():
    case = tiers.Case("h", "T6", "humidity", "P0", humidity=True, hide_columns=True)
    built = campaigns.build(case, 4)
    assert set(built.columns) == {"D1_um", "D2_um", "D3_um"}
    assert built.answer["effects"][0]["mechanism"] == "humidity"


def test_plan_is_complete_and_unique():
    cases = tiers.plan()
    assert len({case.id for case in cases}) == len(cases)
    assert sum(case.cell == "clean" for case in cases) == 500
    assert all(sum(case.cell == name for case in cases) == 200 for name in noise.NUISANCES)
    part = tiers.plan(fraction=0.1)
    assert {case.id for case in part} <= {case.id for case in cases}
    assert len(part) == pytest.approx(0.1 * len(cases), abs=4)
    assert {case.tier for case in part} == set(tiers.TIERS)


# --- independence ----------------------------------------------------------------------------------------------------
def test_the_generator_knows_nothing_of_the_library():
    allowed = {"__future__", "collections", "dataclasses", "hashlib", "numpy", "pathlib", "scipy", "types", "zlib"}
    for file in (ROOT / "benchmarks/blind/generator").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            found = []
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found = [node.module]
            assert {name.split(".")[0] for name in found} <= allowed, file.name
    code = "import sys; from benchmarks.blind.generator import tiers, campaigns; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not {"mcc_jax", "jax"} & set(done.stdout.split())
