"""Who is tested, how, and with what noise."""

from __future__ import annotations

from dataclasses import dataclass, field

from . import noise, particles, path


@dataclass(frozen=True)
class Campaign:
    """memory: curves that an effect keeps because they depend on the path alone."""

    particles: particles.Particles
    path: path.Path
    noise: noise.Noise
    memory: dict = field(default_factory=dict)

    @property
    def owner(self):
        return self.path.owner


def draw(
    rng,
    count=20,
    protocol="P0",
    *,
    reloads=0,
    noise_kind="clean",
    wide=False,
    low_turn=False,
    modulus_scatter=0.0,
    humidity=None,
):
    """Draw a campaign: particles, then their paths, then the noise."""
    tested = particles.draw(rng, count, wide, modulus_scatter, humidity)
    loaded = path.draw(rng, tested, protocol, reloads, low_turn)
    return Campaign(tested, loaded, noise.draw(rng, loaded, noise_kind))
