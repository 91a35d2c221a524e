"""What the posterior says of curves: of the measured particles, of new ones, and of whole populations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._errors import InputError
from ..campaign import PAPER_EFFECTIVE_MODULUS_MPA, PAPER_LOG_C, PAPER_SHAPE_PARAMETER, particle_batch
from ..law import MccLaw, Plastic
from .compiling import compiled
from .estimates import summary
from .population import COEFFICIENTS
from .results import PosteriorDraws

A_CALIBRATION = "Make one with mcc_jax.calibrate_bayes(campaign)."


@dataclass(frozen=True)
class PredictedCurves:
    """Draws of one particle's displacement along a path of forces.

    Attributes:
        force_mN: the path [mN], shape (n,).
        displacement_um: draws without read-out noise [um], shape (draws, n).
        observed_um: the same with noise, None where noise was not asked for.
        laws: the law of each draw, every array field with a leading axis.
    """

    force_mN: np.ndarray
    displacement_um: np.ndarray
    observed_um: np.ndarray | None
    laws: MccLaw

    def band(self, share: float = 0.95, *, observed: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper end of the central interval that holds `share` of the draws at each force [um].

        Raises:
            ValueError: if the share is not between 0 and 1, or noise was asked for but not drawn.
        """
        share = arguments.number(share, "the share", above=0, below=1)
        draws = self.observed_um if observed else self.displacement_um
        if draws is None:
            raise InputError("these curves were drawn without noise")
        low, high = np.quantile(draws, [(1 - share) / 2, (1 + share) / 2], axis=0)
        return low, high


@compiled
def _paths(laws: MccLaw, particles: Any, forces: Any):
    return jax.lax.map(lambda one: one[0].path_load(one[1], one[0].init(one[1]), one[2])[1], (laws, particles, forces))


def _laws(calibration: PosteriorDraws, C: np.ndarray, a: np.ndarray, modulus: np.ndarray) -> MccLaw:
    model = calibration.model

    def one(C: Any, a: Any, E: Any) -> MccLaw:
        return MccLaw(Plastic(C[0], C[1], C[2]), a, E, model.unloading, model.strain_scaling)

    return eqx.filter_vmap(one)(jnp.asarray(C), jnp.asarray(a), jnp.asarray(modulus))


def sample_laws(calibration: PosteriorDraws, count: int, *, seed: int = 0) -> MccLaw:
    """Laws of particles never measured, for DEM or any other use: one posterior draw of the population each.

    They carry both the scatter of the particles and the uncertainty of the population. Laws that are not monotone are
    kept, as the population has them (`MccLaw.is_monotone` tells).

    Args:
        calibration: the posterior.
        count: how many.
        seed: random seed.

    Returns:
        A batched law, every array field with a leading axis.
    """
    arguments.instance(calibration, PosteriorDraws, "calibration", A_CALIBRATION)
    count = arguments.whole(count, "count", least=1)
    rng = np.random.default_rng(arguments.seed(seed))
    p = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *np.asarray(x).shape[2:]), calibration.population)
    pick = rng.integers(len(p.a), size=count)
    C = np.exp(p.mu[pick] + p.tau[pick] * rng.standard_normal((count, 3)))
    a = p.a[pick] + p.shape_scatter[pick] * rng.standard_normal(count)
    modulus = np.exp(p.log_modulus[pick] + p.modulus_scatter[pick] * rng.standard_normal(count))
    return _laws(calibration, C, a, modulus)


def predict_new_particle(
    calibration: PosteriorDraws,
    diameters_um: Any,
    force_mN: Any,
    *,
    count: int = 500,
    seed: int = 0,
) -> PredictedCurves:
    """Draws of the curve of a particle that was never measured.

    Args:
        calibration: the posterior.
        diameters_um: its D1, D2, D3 [um].
        force_mN: path of forces, loading and unloading [mN], shape (n,).
        count: number of draws.
        seed: random seed.

    Raises:
        InputError: for diameters that are not positive, or a path that is none.
    """
    arguments.instance(calibration, PosteriorDraws, "calibration", A_CALIBRATION)
    sizes = arguments.one_particle(diameters_um)
    force_mN = np.asarray(arguments.path(force_mN, "force_mN"))
    if not np.isfinite(force_mN).all():
        raise InputError(f"force_mN is {force_mN[~np.isfinite(force_mN)][0]} at one point", remedy="Leave it out.")
    laws = sample_laws(calibration, count, seed=seed)
    paths = np.broadcast_to(np.asarray(force_mN, float), (count, len(force_mN)))
    particles = particle_batch(np.broadcast_to(sizes, (count, 3)))
    return PredictedCurves(
        np.asarray(force_mN, float), np.asarray(_paths(laws, particles, jnp.asarray(paths))), None, laws
    )


def predict_measured(calibration: PosteriorDraws, particle: str, *, count: int = 200, seed: int = 0) -> PredictedCurves:
    """Draws of a measured particle's curve at its measured forces, its zero included, without and with noise.

    Args:
        calibration: the posterior.
        particle: its name.
        count: number of draws.
        seed: random seed.

    Raises:
        InputError: if the particle did not take part.
    """
    arguments.instance(calibration, PosteriorDraws, "calibration", A_CALIBRATION)
    count = arguments.whole(count, "count", least=1)
    seed = arguments.seed(seed)
    if particle not in calibration.particles:
        known = ", ".join(calibration.particles)
        raise InputError(f"particle {arguments.shown(particle)} did not take part", remedy=f"There are: {known}.")
    row = calibration.particles.index(particle)
    tests = calibration.selection.tests
    length = len(calibration.selection.rows[row])
    rng = np.random.default_rng(seed)
    chains, draws = calibration.zero_um.shape[:2]
    pick = rng.choice(chains * draws, size=min(count, chains * draws), replace=False)

    def chosen(values: np.ndarray) -> np.ndarray:
        return values.reshape(chains * draws, *values.shape[2:])[pick]

    laws = _laws(
        calibration,
        chosen(calibration.C[:, :, row]),
        chosen(np.asarray(calibration.population.a)),
        chosen(calibration.modulus_MPa[:, :, row]),
    )
    force = np.asarray(tests.force[row])
    particles = particle_batch(
        np.broadcast_to(calibration.campaign.diameters_um[calibration.selection.kept[row]], (len(pick), 3))
    )
    paths = jnp.asarray(np.broadcast_to(force, (len(pick), len(force))))
    clean = np.asarray(_paths(laws, particles, paths))[:, :length] + chosen(calibration.zero_um[:, :, row])[:, None]
    # Noise as a tester would add it: one over the filter's weight where points count, their median elsewhere.
    noise = calibration.fit.noise
    weight = np.asarray(calibration.fit.filters.weight[row])[:length]
    usual = 1 / np.median(weight[weight > 0])
    factor = np.exp(chosen(np.asarray(calibration.population.log_noise)))[:, None]
    white = np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), usual)
    correlated = float(noise.correlated) * float(noise.scale[row])
    step = np.asarray(tests.step[row])[:length]
    wander = _wander(rng, step, correlated, max(float(noise.length), 1e-9), len(pick))
    read = np.sqrt(np.maximum(white**2 - correlated**2, 0.05 * white**2))
    observed = clean + factor * (wander + read * rng.standard_normal(clean.shape))
    return PredictedCurves(force[:length], clean, observed, laws)


def _wander(rng: np.random.Generator, step: np.ndarray, sd: float, length: float, count: int) -> np.ndarray:
    """Paths of an Ornstein-Uhlenbeck process, shape (count, n)."""
    decay = np.exp(-step / length)
    values = np.empty((count, len(step)))
    values[:, 0] = sd * rng.standard_normal(count)
    for k in range(1, len(step)):
        values[:, k] = decay[k] * values[:, k - 1] + sd * np.sqrt(1 - decay[k] ** 2) * rng.standard_normal(count)
    return values


def compare_with_paper(calibration: PosteriorDraws) -> list[dict[str, Any]]:
    """The paper's Table 2, a and modulus beside ours: one row per quantity, with mean, sd and 95 % interval of ours."""
    arguments.instance(calibration, PosteriorDraws, "calibration", A_CALIBRATION)
    named = calibration.named_population()
    paper: dict[str, float | None] = {"a": PAPER_SHAPE_PARAMETER}
    printed = calibration.model.unloading.value == "printed"
    paper["effective_modulus_MPa"] = PAPER_EFFECTIVE_MODULUS_MPA if printed else None
    for name in COEFFICIENTS:
        paper[f"mu_{name}"], paper[f"tau_{name}"] = PAPER_LOG_C[name]
    return [{"quantity": name, "paper": value, **summary(named[name])} for name, value in paper.items()]
