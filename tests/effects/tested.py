"""One test with everything in it, and every variant's response along it at several amplitudes at once."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from helpers import paper_law, paper_particle

from mcc_jax.calibrate.forward import Forms
from mcc_jax.effects import LIBRARY, clean_record
from mcc_jax.law import Unloading, signatures

MECHANISMS = tuple(LIBRARY)
VARIANTS = tuple(variant for mechanism in LIBRARY.values() for variant in mechanism)
NAMES = [v.label for v in VARIANTS]
PARTICLE = paper_particle(3)
LAW = paper_law()
HUMIDITY = 65.0

# Load, hold, partial unload, reload, partial reload and back, second reload beyond at another rate, hold, full unload,
# out of contact, reload to half, unload; with points that repeat, time included or not.
TURNS = np.array(
    [
        (0, 0), (80, 160), (110, 160), (140, 100), (150, 100), (170, 130), (180, 110), (220, 200), (240, 300),
        (280, 300), (380, 0), (390, 0), (390, 0), (460, 140), (500, 140), (570, 0), (570, 0),
    ],
    float,
)  # fmt: skip


TIME = jnp.asarray(np.sort(np.concatenate([np.linspace(0, TURNS[-1, 0], 90), TURNS[:, 0], [40.0, 300.0]])))
FORCE = jnp.asarray(np.interp(TIME, TURNS[:, 0], TURNS[:, 1]))
RECORD = clean_record(FORCE, TIME, relative_humidity=jnp.asarray(HUMIDITY))
START, MIDDLE = 1e-3, 1e-3  # steps of finite differences over the typical amplitude


def latent_law():
    """The same law as a fit has it: a = 0, coefficients multiplied by the shape factor."""
    eta = LAW.shape_factor(PARTICLE)
    C = jnp.stack([LAW.plastic.C1, LAW.plastic.C3, LAW.plastic.C5])
    latent = jnp.concatenate([jnp.log(C * eta), jnp.log(LAW.effective_modulus)[None]])
    return Forms(Unloading.PRINTED).law(latent, jnp.zeros(0))


def respond(variant, amplitude, law=LAW, record=RECORD, particle=PARTICLE, **nuisance):
    return law.with_effects(variant.build(amplitude, **nuisance)).respond(particle, record)


def base(record=RECORD, particle=PARTICLE):
    return LAW.path_load(particle, LAW.init(particle), record.force)[1]


BASE = np.asarray(base())


def added(variant, amplitude, record=RECORD, **nuisance):
    """What an effect adds along a record [um]."""
    return np.asarray(respond(variant, amplitude, record=record, **nuisance) - base(record))


@functools.cache
def lanes(variant):
    """Displacement and its derivative by the amplitude at 0, h, 2h, a - h, a, a + h, and at a with the fit's law."""
    a = variant.typical
    amplitudes = jnp.asarray([0, START * a, 2 * START * a, (1 - MIDDLE) * a, a, (1 + MIDDLE) * a, a])
    laws = jax.tree.map(lambda x, y: jnp.stack([x] * 6 + [y]), LAW, latent_law())

    def one(law, amplitude):
        f = functools.partial(respond, variant, law=law)
        return jax.jvp(lambda x: f(x), (amplitude,), (jnp.ones_like(amplitude),))

    values, slopes = eqx.filter_vmap(one)(laws, amplitudes)
    return np.asarray(values), np.asarray(slopes)


LENGTH = 448
"""Points to which records are filled up for one compilation: as many as the longest has, or more."""


@functools.cache
def _signature_rows():
    effects = [v.build(0.0) for v in VARIANTS]
    return eqx.filter_jit(eqx.filter_vmap(lambda record: signatures(LAW, PARTICLE, record, effects)))


def signature_rows(one, other):
    """Signatures of every variant along two records: one function, compiled for records of one length."""

    def padded(x):
        return jnp.asarray(np.pad(x, (0, LENGTH - len(x)), mode="edge")) if x.ndim else x

    both = jax.tree.map(lambda *leaves: jnp.stack([padded(leaf) for leaf in leaves]), one, other)
    rows = np.asarray(_signature_rows()(both))
    return rows[0][:, : one.force.size], rows[1][:, : other.force.size]
