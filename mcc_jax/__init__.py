"""Loading-unloading contact law of microcrystalline cellulose particles: simulate, calibrate, discover, embed.

Everything public is here or in `mcc_jax.law`, `mcc_jax.campaign`, `mcc_jax.effects`, `mcc_jax.simulate`,
`mcc_jax.calibrate`, `mcc_jax.discovery`, `mcc_jax.dem`, `mcc_jax.export`, `mcc_jax.plots` and `mcc_jax.report`.
Units: MPa, um, mN, s, nJ; only `mcc_jax.dem` talks SI.
Switch JAX to double precision first, unless you mean single:
`jax.config.update("jax_enable_x64", True)`.
"""

import lazy_loader as _lazy

from ._version import __version__ as __version__

# The public names are in `__init__.pyi`, one by one, and are loaded at first use: `mcc-jax --help` has answered
# before JAX could be imported.
__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
