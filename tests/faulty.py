"""Simulated campaigns, and what instruments do to them: an offset, a clipped channel, breakage, a stuck logger."""

import functools
from dataclasses import replace

import numpy as np

from mcc_jax.campaign import Curve
from mcc_jax.simulate import Instrument, paper_campaign

MODULUS_MPA = 16000.0


def campaign(count=12, *, seed=0, noise_um=0.05, noise_mN=0.05):
    """The first particles of the paper, loaded once and unloaded; the truth is the paper's."""
    instrument = Instrument(displacement_noise_um=noise_um, force_noise_mN=noise_mN)
    return paper_campaign(seed, instrument=instrument).select(np.arange(20) < count)


def changed(campaign, change, *, only=None):
    """Every curve (or those of the named particles) changed by a function of its three columns."""
    curves = [
        Curve(*change(c.time_s.copy(), c.force_mN.copy(), c.displacement_um.copy())) if only is None or n in only else c
        for n, c in zip(campaign.particles, campaign.curves, strict=True)
    ]
    return replace(campaign, curves=tuple(curves))


def in_air(campaign, *, readings=40, offset_mN=0.0, drift_mN=0.0, noise_mN=0.05, noise_um=0.05, seed=1):
    """Readings in the air before contact, and a load cell that is off by so much everywhere."""
    rng = np.random.default_rng(seed)

    def change(time, force, path):
        step = (time[-1] - time[0]) / (len(time) - 1)
        ahead = np.arange(-readings, 0)
        air = noise_mN * rng.standard_normal(readings)
        come = path[0] + 0.4 * ahead + noise_um * rng.standard_normal(readings)
        drifting = offset_mN + drift_mN * np.linspace(0, 1, readings)
        return (
            np.concatenate([time[0] + step * ahead, time]),
            np.concatenate([air + drifting, force + offset_mN + drift_mN]),
            np.concatenate([come, path]),
        )

    return changed(campaign, change)


def clipped(campaign, share, *, only=None, channel="force"):
    """A channel that reads no more than a share of its true largest value."""

    def change(time, force, path):
        values = force if channel == "force" else path
        np.minimum(values, share * values.max(), out=values)
        return time, force, path

    return changed(campaign, change, only=only)


def broken(campaign, *, at=0.7, left=0.3, only=None):
    """A particle that breaks at a share of its largest force: the force falls at once while the platens go on."""

    def change(time, force, path):
        i = int(np.argmax(force >= at * force.max()))
        n = len(time) - i - 1
        rest = force[i] * left * (1 + 0.2 * np.sin(np.arange(n)))
        on = path[i] + (path[i] - path[i - 10]) / 10 * np.arange(1, n + 1)
        return time, np.concatenate([force[: i + 1], rest]), np.concatenate([path[: i + 1], on])

    return changed(campaign, change, only=only)


def stuck(campaign, *, start=60, readings=15, channel="force", only=None):
    """A channel (or "both") that repeats a reading for a while, then goes on where it should be."""

    def change(time, force, path):
        for name, values in (("force", force), ("displacement", path)):
            if channel in (name, "both"):
                values[start + 1 : start + readings] = values[start]
        return time, force, path

    return changed(campaign, change, only=only)


def spiked(campaign, *, height=1e6, channel="displacement", at=77, only=None):
    """One reading that is nonsense."""

    def change(time, force, path):
        (path if channel == "displacement" else force)[at] += height
        return time, force, path

    return changed(campaign, change, only=only)


def inserted(time, force, path, at, more, climb):
    """A test with more forces behind a reading, while the platens climb so far; what follows is later and further."""
    step, count = time[1] - time[0], len(more)
    return (
        np.concatenate([time[: at + 1], time[at] + step * np.arange(1, count + 1), time[at + 1 :] + step * count]),
        np.concatenate([force[: at + 1], more, force[at + 1 :]]),
        np.concatenate([path[: at + 1], path[at] + climb, path[at + 1 :] + climb[-1]]),
    )


@functools.cache
def exact():
    """Four particles without noise; `noisy` adds it."""
    return campaign(4, noise_um=0.0, noise_mN=0.0)


def noisy(tests, seed, noise_um=0.05, noise_mN=0.05):
    """White noise on both channels of every curve."""
    rng = np.random.default_rng(seed)

    def change(time, force, path):
        noise = rng.standard_normal((2, len(time)))
        return time, force + noise_mN * noise[0], path + noise_um * noise[1]

    return changed(tests, change)
