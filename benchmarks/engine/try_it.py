"""What the prototype says of a few campaigns of the library's own simulator.

Run `python -m benchmarks.engine.try_it [CASE ...]`. These are campaigns it was built on: no measure of how good it is.
"""

from __future__ import annotations

import sys
import time

import jax

import mcc_jax as mcc
from mcc_jax.campaign import available_data
from mcc_jax.discover.candidates import untestable
from mcc_jax.effects import LIBRARY, Mechanism, find_variant

from .design import Base
from .search import Searcher

CASES = {
    "1": [],
    "2": [("frame_compliance:linear", 1e-3)],
    "3": [("creep:power_law", 2e-4)],
    "4": [("damage:exponential", 0.5)],
    "5": [("reload_hysteresis:parabolic", 0.08), ("frame_compliance:linear", 2e-3)],
    "6": [("adhesion:bond", 0.5)],
    "7": [("toe_asperity:exponential", 0.003)],
    "8": [("unloading_shape:tail_bow", 0.05)],
    "9": [("thermal_drift:linear", 2e-3)],
    "10": [("pop_in:sharp", 0.8)],
    "11": [],
    "13": [("rate_dependence:flow_log_strain_rate", 0.05)],
    "14": [("platen_friction:siebel", 0.2)],
    "15": [("damage:stress", 0.6), ("toe_asperity:hyperbolic", 0.004)],
}


def one(case: str, particles: int = 12) -> None:
    """Print the posterior over hypotheses of one campaign."""
    programme = mcc.Programme.cycles(levels=(0.5, 1.0), hold_s=10.0, points=120)
    hidden = [mcc.HiddenEffect(find_variant(name), amplitude) for name, amplitude in CASES[case]]
    campaign = mcc.paper_campaign(int(case), programme=programme, instrument=mcc.Instrument(0.08, 0.05), effects=hidden)
    campaign = campaign.without(*campaign.particles[particles:])
    model = mcc.Model(modulus_scatter=True)
    start = time.perf_counter()
    fit = mcc.fit(campaign, model, threshold_MPa=0.0)
    library, _ = untestable(LIBRARY, available_data(campaign))
    # Without the width of the punch, which is not recorded: it would be another name for the frame.
    library = {
        name: Mechanism(
            name,
            mechanism.explanation,
            tuple(v for v in mechanism.variants if not any(n.name == "punch_radius_um" for n in v.nuisances)),
        )
        for name, mechanism in library.items()
    }
    found = Searcher(Base(fit, model), library).run()
    print(case, CASES[case], f"{time.perf_counter() - start:.0f} s")
    for names, probability in list(found.posterior(len(library)).items())[:4]:
        print("   ", names or "nothing", round(probability, 3))
    for named in sorted(found.found.values(), key=lambda x: -x.value)[:4]:
        gains = (round(x - found.null.log_evidence, 1) for x in (named.alone, named.misfit))
        print("       ", named.names, *gains, named.rho, flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for chosen in sys.argv[1:] or CASES:
        one(chosen)
