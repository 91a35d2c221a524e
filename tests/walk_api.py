"""Calls what is public with values that people mistype, and writes what came of it as JSON to standard output.

Run by `tests/test_public_api.py` in a process of its own, in which the annotations are not enforced: what refuses a
wrong argument there is the library, as at a user's.
"""

import dataclasses
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

jax.config.update("jax_enable_x64", True)
import mcc_jax as mcc  # noqa: E402
from mcc_jax import calibrate, campaign, dem, effects, export, simulate  # noqa: E402


def outcome(call, **arguments) -> str:
    """ "refused: " and the message, "accepted", or the error that should have been an `InputError`."""
    try:
        call(**arguments)
    except mcc.InputError as error:
        return f"refused: {error}"
    except Exception as error:  # noqa: BLE001: whatever else a user would see is what is looked for
        return f"{type(error).__name__}: {error}"
    return "accepted"


class Example:
    """A valid call: the function or class, and its arguments by name.

    Numbers in `signed` may be negative. Only with `run` is the valid call run, to compare lists and Series.
    """

    def __init__(self, call, *, signed=(), run=True, **given):
        self.call, self.given, self.signed, self.run = call, given, signed, run


def examples(folder: Path) -> list[Example]:
    """One call of everything that takes numbers, options or arrays."""
    the_law, particle = mcc.paper_law(), mcc.Particle(150.0, 130.0, 120.0)
    path = np.linspace(0.0, 20.0, 8)
    force = the_law.path_load(particle, the_law.init(particle), jax.numpy.linspace(0.0, 80.0, 8))[1]
    curve = mcc.Curve(np.linspace(0.0, 7.0, 8), np.linspace(0.0, 80.0, 8), np.asarray(force))
    tests = mcc.paper_campaign(0).select(np.arange(20) < 3)
    adjustment = mcc.adjust(tests)
    table = calibrate.strain_table(adjustment, tests.diameters_um)
    sizes, peaks = tests.diameters_um, np.array([400.0, 300.0, 350.0])
    laws = jax.vmap(lambda _: the_law)(np.arange(3.0))
    programme = mcc.Programme.cycles()
    heights = np.linspace(2e-4, 1.9e-4, 3)
    packing = dem.spheres(the_law, [1e-4, 1.2e-4])
    return [
        Example(mcc.Particle, D1=150.0, D2=130.0, D3=120.0),
        Example(mcc.Plastic, C1=7.0, C3=27.0, C5=140.0, signed=("C3",)),
        Example(mcc.law.LogNormal, mean=2.0, sd=0.3, signed=("mean",)),
        Example(mcc.MccLaw, plastic=mcc.Plastic(7.0, 27.0, 140.0), a=1.4, effective_modulus=1.6e4, signed=("a",),
            unloading="printed", strain_scaling="raw"),
        Example(mcc.paper_law, unloading="printed", strain_scaling="raw"),
        Example(mcc.drive, law=the_law, particle=particle, path=path, control="displacement"),
        Example(mcc.simulate.simulate_batch, laws=laws, particles=campaign.particle_batch(sizes),
            paths=np.tile(path, (3, 1)), control="displacement"),
        Example(mcc.simulate_campaign, laws=laws, diameters_um=sizes, peaks=peaks, programme=programme, seed=1,
            run=False),
        Example(mcc.paper_campaign, seed=0, unloading="printed", strain_scaling="raw", run=False),
        Example(mcc.Ramp, to=1.0, rate=20.0, signed=("to",)),
        Example(mcc.Hold, seconds=20.0),
        Example(mcc.Programme, control="load", steps=[mcc.Ramp(1.0, 20.0)], interval_s=0.1),
        Example(mcc.Programme.cycles, control="load", rate=2.0, unload_to=0.0, hold_s=1.0, interval_s=0.1),
        Example(mcc.Instrument, displacement_noise_um=0.1, force_noise_mN=0.1, displacement_resolution_um=0.1,
            force_resolution_mN=0.1, zero_um=0.1, signed=("zero_um",)),
        Example(simulate.read_effect, text="creep:logarithmic=0.02"),
        Example(effects.find_variant, name="creep"),
        Example(mcc.Curve, time_s=curve.time_s, force_mN=curve.force_mN, displacement_um=curve.displacement_um),
        Example(mcc.Campaign, particles=["a"], diameters_um=np.full((1, 3), 100.0), curves=[curve]),
        Example(mcc.campaign.Metadata, control="load", force_resolution_mN=0.1, punch_diameter_um=500.0),
        Example(mcc.campaign.find_segments, curve=tests.curves[0], control="load"),
        Example(mcc.adjust, campaign=tests, threshold_MPa=0.2),
        Example(calibrate.strain_table, adjustment=adjustment, diameters_um=sizes),
        Example(calibrate.fit_shape_parameter, table=table, objective="full"),
        Example(mcc.Model, unloading="printed", strain_scaling="raw", modulus_scatter=False, shape_scatter=False),
        Example(mcc.calibrate.LogNormalPrior, median=6.0, log_sd=0.5),
        Example(mcc.calibrate.NormalPrior, mean=1.0, sd=1.0, signed=("mean",)),
        Example(mcc.calibrate.NakagamiPrior, sd=0.3, shape=0.5),
        Example(mcc.calibrate_paper, campaign=tests, threshold_MPa=0.2, objective="full", unloading="printed",
            strain_scaling="raw", seed=0, run=False),
        Example(mcc.least_squares, campaign=tests, threshold_MPa=0.2, loss="linear", seed=0, run=False),
        Example(mcc.sample, campaign=tests, threshold_MPa=0.2, mode="fast", chains=4, warmup=300, draws=1000, seed=0,
            run=False),
        Example(mcc.calibrate_many, campaigns=[tests], method="least_squares", threshold_MPa=0.2, run=False),
        Example(mcc.discover, campaign=tests, exclude=[], threshold_MPa=0.2, confirm=True, seed=0, run=False),
        Example(mcc.simulate.law_for_each, plastic=mcc.simulate.paper_population().sample(jax.random.key(0), 3), a=1.4,
            effective_modulus_MPa=1e4, unloading="printed", strain_scaling="raw", signed=("a",)),
        Example(mcc.geometry.plastic_shape_factor, particle=particle, a=1.4, signed=("a",)),
        Example(dem.spheres, law=the_law, diameter=np.array([1e-4, 1.2e-4]), density=1540.0),
        Example(dem.die, radius=1e-3, height=2e-3),
        Example(dem.scattered, key=jax.random.key(0), radius=np.array([5e-5, 6e-5]), die_radius=1e-3, gap=0.02),
        Example(dem.Interaction, damping=0.1, friction=0.3, wall_friction=0.2, tangential_ratio=0.8),
        Example(dem.Motion.of, time_step=1e-8, drag=0.0),
        Example(dem.stable_time_step, packing=packing, safety=0.3),
        Example(dem.relative_density, packing=packing, radius=1e-3, bottom=0.0, top=1e-3, signed=("bottom", "top")),
        Example(dem.close_pairs, position=np.array([[0, 0, 0], [0, 0, 1e-4]]), radius=np.array([5e-5, 6e-5]),
            skin=1e-5),
        Example(dem.start, packing=packing, walls=dem.die(1e-3, 2e-3), position=np.array([[0, 0, 5e-4], [0, 0, 9e-4]]),
            skin=1e-5, capacity=16, run=False),
        Example(dem.Plane, point=np.zeros(3), normal=np.array([0.0, 0.0, 1.0]), velocity=np.zeros(3)),
        Example(dem.Cylinder, radius=1e-3, rim=2e-3, chamfer=1e-4, velocity=np.zeros(3), signed=("rim",)),
        Example(dem.Solver, rtol=1e-10, max_steps=150, halvings=4, skin=0.5),
        Example(dem.fit_compaction, packing_of=lambda _: packing, start=np.ones(2), state=None, heights=heights,
            force=heights, run=False),
        Example(export.golden_table, law=the_law, particle=particle, seed=0, units="SI", run=False),
        Example(export.jax_artefact, law=the_law, particle=particle, which="step", dtype="float64", run=False),
        Example(export.write_export, format="c", law=the_law, particle=particle, folder=folder, seed=0, run=False),
        Example(mcc.in_blocks, function=lambda x: x, block=4),
    ]  # fmt: skip


def same(one: Any, other: Any) -> bool:
    """Whether two results hold the same numbers."""
    first, second = jax.tree.leaves(_open(one)), jax.tree.leaves(_open(other))
    return len(first) == len(second) and all(
        np.array_equal(a, b, equal_nan=True)
        for a, b in zip(first, second, strict=True)
        if isinstance(a, np.ndarray | jax.Array | float)
    )


def _open(result: Any) -> Any:
    fields = dataclasses.is_dataclass(result) and not isinstance(result, type)
    return {f.name: getattr(result, f.name, None) for f in dataclasses.fields(result)} if fields else result


def walk(example: Example) -> dict[str, str]:
    """What comes of each of the mistakes that an example's arguments allow."""
    found: dict[str, str] = {}

    def called(**changed: Any) -> Any:
        return example.call(**example.given | changed)

    reference = called() if example.run else None
    arrays = {n: v for n, v in example.given.items() if isinstance(v, np.ndarray)}
    for name, value in example.given.items():
        trials: dict[str, Any] = {}
        if isinstance(value, bool):
            trials = {"a text": "no"}
        elif isinstance(value, str):
            trials = {"misspelt": "mispelt"}
        elif isinstance(value, int | float):
            trials = {"NaN": float("nan"), "a text": "nonsense", "infinity": -np.inf}
            if name not in example.signed:
                trials["negative"] = -abs(value) or -1
        elif isinstance(value, np.ndarray):
            trials = {"a text": "nonsense", "texts": ["a"] * len(value)}
            if value.ndim == 1 and len(value) > 3:
                trials["a scalar"] = 1.0
            if len(value) > 1 and any(n != name and len(v) == len(value) for n, v in arrays.items()):
                trials["one too few"] = value[:-1]
        for kind, trial in trials.items():
            found[f"{name} = {kind}"] = outcome(called, **{name: trial})
        if isinstance(value, np.ndarray) and example.run:
            for kind, make in {"a list": np.ndarray.tolist, "a Series": pd.Series}.items():
                if kind == "a list" or value.ndim == 1:
                    again = called(**{name: make(value)})
                    found[f"{name} = {kind}"] = "same" if same(again, reference) else "another answer"
    return found


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        json.dump({one.call.__qualname__: walk(one) for one in examples(Path(folder))}, sys.stdout)


if __name__ == "__main__":
    main()
