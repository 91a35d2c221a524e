"""One process of several that calibrate a campaign together: prints its numbers as JSON.

Arguments: address of the coordinator, number of processes, this one's number; or nothing, to do it alone.
"""

import json
import sys

import jax

jax.config.update("jax_enable_x64", True)
if len(sys.argv) > 1:
    address, count, own = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(address, count, own, initialization_timeout=60)

import numpy as np  # noqa: E402  # JAX has to know its processes before anything is computed

from mcc_jax import calibrate_bayes, calibrate_least_squares, paper_campaign  # noqa: E402
from mcc_jax.calibrate.joint._data import select_tests  # noqa: E402
from mcc_jax.calibrate.joint._devices import spread  # noqa: E402
from mcc_jax.simulate import Instrument, Programme  # noqa: E402

# Five particles: they do not divide among two processes.
instrument = Instrument(displacement_noise_um=0.02, force_noise_mN=0.05)
campaign = paper_campaign(0, instrument=instrument, programme=Programme.cycles(points=60)).select(np.arange(20) < 5)
tests = spread(select_tests(campaign).tests)
posterior = calibrate_bayes(campaign, chains=2, warmup=150, draws=100)
fitted = calibrate_least_squares(campaign)


def numbers(*arrays):
    return [np.asarray(a).tolist() for a in arrays]


fit = posterior.fit
found = {
    "processes": jax.process_count(),
    "parts": [list(shard.data.shape) for shard in tests.force.addressable_shards],
    "fit": numbers(fit.latent, fit.zero, fit.mode, fit.covariance, fit.noise.logs, fit.noise.scale, fit.residual),
    "posterior": numbers(*jax.tree.leaves(posterior.population), posterior.C, posterior.zero_um),
    "likelihood": numbers(posterior.log_likelihood, posterior.modulus_MPa, posterior.shape_factor),
    "least squares": numbers(fitted.solution.value.local, fitted.solution.value.shared),
    "json": {**posterior.to_json(), "runtime_s": 0.0},
}
print(json.dumps(found))
