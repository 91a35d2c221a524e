"""One process of a calibration that is spread over several: run by `test_spread.py`, one after another or together."""

import json
import sys
from pathlib import Path

import jax
import numpy as np


def squares(force):
    """A function of every particle of a block."""
    return jax.numpy.sum(force**2, 1)


def blocks_only(folder: Path, process: int) -> None:
    """One cheap function of five particles in blocks of two."""
    from joint_cases import five_tests

    from mcc_jax.calibrate.running import Blocks, compiled, require_same

    tests = five_tests()
    require_same(tests)
    found = Blocks(len(tests), 2).all(compiled(squares), (tests.force,))
    np.savez(folder / f"arrays_{process}.npz", squares=np.asarray(found))


def main(folder: Path, address: str, processes: int, process: int, seed: int, everything: int) -> None:
    """Calibrate five particles in blocks of two, and write what was found."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    if processes > 1:
        jax.distributed.initialize(address, processes, process, initialization_timeout=60)
    devices = {"devices": jax.local_device_count(), "processes": jax.process_count()}
    (folder / f"devices_{process}.json").write_text(json.dumps(devices), encoding="utf-8")
    if not everything:
        blocks_only(folder, process)
        return
    # Not before: nothing may ask for devices before the processes know of each other.
    from joint_cases import five_particles

    from mcc_jax.calibrate import fitting, posterior, sample
    from mcc_jax.calibrate.running import Blocks

    fitting.Blocks = lambda count, size=2: Blocks(count, size)
    posterior.block_size = lambda count: 2
    campaign = five_particles(seed)
    try:
        found = sample(campaign, chains=2, warmup=100, draws=60, seed=3)
    except Exception as error:
        (folder / f"error_{process}.txt").write_text(f"{type(error).__name__}: {error}", encoding="utf-8")
        raise
    arrays = {
        "mode": found.fit.mode,
        "covariance": found.fit.covariance,
        "noise": found.fit.noise.noise.logs,
        "noise_log_sd": found.fit.noise.log_sd,
        "scale": found.fit.noise.noise.scale,
        "latent": found.fit.point.latent,
        "residual": found.fit.residual,
        "variance": found.fit.filters.solver.factor.diag.d,
        "gram": found.fit.marginal.gram,
        **found.named_population(),
        **{name: getattr(found, name) for name in ("C", "modulus_MPa", "zero_um", "log_likelihood", "pareto_k")},
    }
    np.savez(folder / f"arrays_{process}.npz", **{name: np.asarray(value) for name, value in arrays.items()})
    if jax.process_index() == 0:
        found.to_arviz().to_netcdf(folder / "posterior.nc")
        content = {**found.to_json(), "runtime_s": None}
        (folder / "calibration.json").write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], *(int(v) for v in sys.argv[3:]))
