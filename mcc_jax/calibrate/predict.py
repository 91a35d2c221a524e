"""What the posterior says of curves: of the measured particles, of new ones, and of whole populations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import described
from ..campaign import PAPER_EFFECTIVE_MODULUS_MPA, PAPER_LOG_C, PAPER_SHAPE_PARAMETER
from ..effects import Record
from ..geometry import Particle
from ..law import MccLaw, Plastic
from .compiling import compiled
from .estimates import summary
from .model import Model
from .noise import Whitening
from .population import COEFFICIENTS, flattened

if TYPE_CHECKING:
    from .posterior import Posterior


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

    __repr__ = described()

    def band(self, share: float = 0.95, *, observed: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper end of the central interval that holds `share` of the draws at each force [um]."""
        share = arguments.number(share, "the share", above=0, below=1)
        draws = self.observed_um if observed else self.displacement_um
        if draws is None:
            raise InputError("these curves were drawn without noise")
        low, high = np.quantile(draws, [(1 - share) / 2, (1 + share) / 2], axis=0)
        return low, high


@compiled
def _paths(laws: MccLaw, particle: Particle, force: Array, time: Array) -> Array:
    """Displacement [um] of one particle along a clean path, by each of many laws."""
    return jax.lax.map(lambda law: law.path_load(particle, law.init(particle), force, time)[1], laws)


@compiled
def predicted_by(laws: MccLaw, particle: Particle, record: Record) -> Array:
    """Displacement [um] of one particle along its measured test, by each of many laws."""
    return jax.lax.map(lambda law: law.respond(particle, record), laws)


@compiled
def _noise(filters: Whitening, key: Array, count: int) -> Array:
    """Draws of a test's noise [um]; of points that do not count as large as usual."""

    def one(key: Array) -> Array:
        keys = jax.random.split(key, 3)
        white, of_branches, of_zero = (jax.random.normal(k, filters.peak.shape) for k in keys)
        return jnp.where(filters.mask, filters.colour(white, of_branches, of_zero[0]), usual * white)

    variance = jnp.where(filters.mask, filters.solver.matrix.diag.d, jnp.nan)
    usual = jnp.sqrt(jnp.nanmedian(variance))
    return jax.lax.map(one, jax.random.split(key, count))


def laws_with(model: Model, C: np.ndarray, a: np.ndarray, modulus: np.ndarray, theta: np.ndarray) -> MccLaw:
    """Laws with these numbers, every array field with a leading axis."""

    def one(C: Any, a: Any, E: Any, theta: Any) -> MccLaw:
        plastic = Plastic(C[0], C[1], C[2])
        return MccLaw(plastic, a, E, model.unloading, model.strain_scaling, effects=model.forms.build(theta))

    return eqx.filter_vmap(one)(*(jnp.asarray(x) for x in (C, a, modulus, theta)))


def sample_laws(calibration: Posterior, count: int, *, seed: int = 0) -> MccLaw:
    """Laws of `count` particles never measured: one posterior draw of the population each.

    They carry both the scatter of the particles and the uncertainty of the population, in one law whose array fields
    have a leading axis. Laws that are not monotone are kept, as the population has them (see `MccLaw.is_monotone`).
    """
    count = arguments.whole(count, "count", least=1)
    rng = np.random.default_rng(arguments.seed(seed))
    p = flattened(calibration.population)
    pick = rng.integers(len(p.a), size=count)
    C = np.exp(p.mu[pick] + p.tau[pick] * rng.standard_normal((count, 3)))
    a = p.a[pick] + p.shape_scatter[pick] * rng.standard_normal(count)
    modulus = np.exp(p.log_modulus[pick] + p.modulus_scatter[pick] * rng.standard_normal(count))
    theta = np.array(p.theta[pick])
    for j, (k, signed) in enumerate(calibration.model.scatter.varying):
        own = p.theta_scatter[pick, j] * rng.standard_normal(count)
        theta[:, k] = theta[:, k] + own if signed else theta[:, k] * np.exp(own)
    return laws_with(calibration.model, C, a, modulus, theta)


def predict_new_particle(
    calibration: Posterior,
    diameters_um: Any,
    force_mN: Any,
    time_s: Any = None,
    *,
    count: int = 500,
    seed: int = 0,
) -> PredictedCurves:
    """Draws of the curve of a particle that was never measured.

    Args:
        calibration: the posterior.
        diameters_um: its D1, D2, D3 [um].
        force_mN: path of forces, loading and unloading [mN], shape (n,).
        time_s: times of the same points [s], for effects that depend on time; none passes if None.
        count: number of draws.
        seed: random seed.

    Raises:
        InputError: for diameters that are not positive, or a path that is none.
    """
    sizes = arguments.one_particle(diameters_um)
    force = np.asarray(arguments.path(force_mN, "force_mN"), float)
    if not np.isfinite(force).all():
        raise InputError(f"force_mN is {force[~np.isfinite(force)][0]} at one point", remedy="Leave it out.")
    time = np.zeros(len(force)) if time_s is None else np.asarray(arguments.path(time_s, "time_s"))
    arguments.same_length(force_mN=force, time_s=time)
    laws = sample_laws(calibration, count, seed=seed)
    paths = _paths(laws, Particle(*sizes), jnp.asarray(force), jnp.asarray(time))
    return PredictedCurves(force, np.asarray(paths), None, laws)


def predict_measured(calibration: Posterior, particle: str, *, count: int = 200, seed: int = 0) -> PredictedCurves:
    """Draws of a measured particle's curve at its measured forces, its zero included, without and with noise.

    Raises:
        InputError: if the particle did not take part.
    """
    count = arguments.whole(count, "count", least=1)
    seed = arguments.seed(seed)
    if particle not in calibration.particles:
        known = ", ".join(calibration.particles)
        raise InputError(f"particle {arguments.shown(particle)} did not take part", remedy=f"There are: {known}.")
    row = calibration.particles.index(particle)
    chains, draws = calibration.zero_um.shape[:2]
    pick = np.random.default_rng(seed).choice(chains * draws, size=min(count, chains * draws), replace=False)
    return predicted_at(calibration, row, pick, seed)


def predicted_at(calibration: Posterior, row: int, pick: np.ndarray, seed: int) -> PredictedCurves:
    """As `predict_measured`, of the row-th particle at chosen draws of all chains in a row."""
    c, length = calibration, len(calibration.selection.rows[row])
    of_particle = (x[:, :, row] for x in (c.C, c.modulus_MPa, c.theta, c.zero_um))
    C, modulus, theta, zero, a, log_noise = (
        flattened(np.asarray(x))[pick] for x in (*of_particle, c.population.a, c.population.log_noise)
    )
    laws = laws_with(c.model, C, a, modulus, theta)
    test, filters = jax.tree.map(lambda x: x[row], (c.selection.tests, c.fit.filters))
    clean = np.asarray(predicted_by(laws, test.particle, test.record)) + zero[:, None]
    noise = np.asarray(_noise(filters, jax.random.key(seed), len(pick)))
    observed = clean + np.exp(log_noise)[:, None] * noise
    return PredictedCurves(np.asarray(test.force)[:length], clean[:, :length], observed[:, :length], laws)


def compare_with_paper(calibration: Posterior) -> list[dict[str, Any]]:
    """The paper's Table 2, a and modulus next to ours: one row per quantity, with mean, sd and interval of ours."""
    named = calibration.named_population()
    paper: dict[str, float | None] = {"a": PAPER_SHAPE_PARAMETER}
    printed = calibration.model.unloading.value == "printed"
    paper["effective_modulus_MPa"] = PAPER_EFFECTIVE_MODULUS_MPA if printed else None
    for name in COEFFICIENTS:
        paper[f"mu_{name}"], paper[f"tau_{name}"] = PAPER_LOG_C[name]
    return [{"quantity": name, "paper": value, **summary(named[name])} for name, value in paper.items()]
