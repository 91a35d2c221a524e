"""What an effect is: a formula, its drawn numbers, and the steps of the law it changes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np


class Effect:
    """One formula with its own numbers; a hidden effect is a pair (effect, amplitude).

    mechanism: listed name, or "unlisted". text: the formula with the amplitude th. start: a usual amplitude, in `unit`.
    mode: what the base law may take up when lambda is measured (see `projection.MODES`). protocols: those that can show
    it, in the order in which cases use them. reloads: further cycles it asks for. largest: bound of the amplitude, or
    None. signed: whether both signs occur. humidity, wide, low_turn: what particles and path must have. many_at_20:
    whether lambda 20 takes 40 particles.

    Every method is without effect unless a subclass replaces it. theta is the amplitude, c the campaign, s the state of
    `law.simulate`.
    """

    mechanism = ""
    text = ""
    start = 1.0
    unit = ""
    mode = "free"
    protocols = ("P0", "P1")
    reloads = 0
    largest = None
    signed = False
    humidity = False
    wide = False
    low_turn = False
    many_at_20 = False

    def __init__(self, rng):
        self.sign = rng.choice([-1, 1]) if self.signed else 1
        self.drawn = SimpleNamespace(**self.draw(rng))

    def draw(self, rng):
        """The formula's numbers."""
        return {}

    def coefficients(self, theta, c, values):
        """Change C1, C3, C5, modulus and eta of the particles in place."""

    def loading(self, theta, terms):
        """Change the terms of the loading curve in place."""

    def stress(self, theta, c, peak, stress):
        """Largest stress so far and stress that the particle feels."""
        return peak, stress

    def modulus(self, theta, c, s):
        """Factor of the modulus."""
        return 1.0

    def unloading(self, theta, c, s, recovered, ratio):
        """Stress over sigma_P at the recovered fraction."""
        return ratio

    def displacement(self, theta, c, s):
        """Displacement in um beside the law's."""
        return 0.0

    def changes(self, step):
        """Whether this effect replaces the method of that name."""
        return getattr(type(self), step) is not getattr(Effect, step)

    def describe(self):
        """The formula with its numbers."""
        numbers = {name: f"{v:.4g}" if isinstance(v, float) else v for name, v in vars(self.drawn).items()}
        return self.text.format(sg="+" if self.sign > 0 else "-", **numbers)


def log_uniform(rng, low, high):
    """A number between the two, even in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def power(x, exponent):
    """x to the exponent, safe at zero."""
    return np.maximum(x, 1e-12) ** exponent
