"""How well does the paper's calibration recover its own law? Scatter and bias over many simulated campaigns.

Run `uv run python benchmarks/study_shape_parameter.py --write` (about five minutes on two cores): it writes
`benchmarks/results/shape_parameter.md`. Every campaign has the paper's 20 particles, peaks drawn from 7 to 16 MPa,
noise of 0.02 um and 0.05 mN, one load-unload cycle at 2 mN/s and 300 points.
"""

import _report
import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from mcc_jax import Instrument, adjust, paper_campaign  # noqa: E402
from mcc_jax.calibrate import fit_shape_parameter, strain_table  # noqa: E402
from mcc_jax.calibrate.paper_steps import (  # noqa: E402
    campaign_branches,
    fit_effective_modulus,
    fit_population,
    master_curve,
)

RESULT = _report.RESULTS / "shape_parameter.md"
TRUE_A, TRUE_MODULUS = 1.43, 16_000.0


def one(seed, shared_material, threshold, noise):
    """a (full), a (reference), modulus and E[C1], E[C3^3], E[C5^5] of one campaign."""
    instrument = Instrument(displacement_noise_um=0.02, force_noise_mN=0.05) if noise else Instrument()
    campaign = paper_campaign(seed, shared_material=shared_material, instrument=instrument)
    adjustment = adjust(campaign, threshold)
    table = strain_table(adjustment, campaign.diameters_um)
    full, reference = fit_shape_parameter(table, "full"), fit_shape_parameter(table, "reference")
    plastic = fit_population(master_curve(table, full.a), threshold)
    branches = campaign_branches(campaign, adjustment)
    modulus = fit_effective_modulus(branches, table.shape_factor(full.a)).effective_modulus_MPa
    return (full.a, reference.a, modulus, *plastic.polynomial, float(plastic.population.C3.sd == 0))


def rows(seeds):
    cases = [
        ("one material, no noise", True, False),
        ("one material, noise", True, True),
        ("C drawn from Table 2, noise", False, True),
    ]
    for name, shared, noise in cases:
        for threshold in (0.0, 0.2):
            # Without noise and scatter only the peaks differ between campaigns: a tenth of them tells it all.
            count = seeds if not shared else max(seeds // 5, 4)
            values = np.array([one(seed, shared, threshold, noise) for seed in range(count)])
            yield name, threshold, count, values
            print(name, threshold, values[:, :3].mean(axis=0), values[:, :3].std(axis=0), flush=True)


def text(seeds):
    lines = [
        "# How well the paper's calibration recovers its own law",
        "",
        f"`uv run python benchmarks/study_shape_parameter.py --campaigns {seeds} --write`",
        "",
        "Campaigns simulated from the paper's Tables 1 and 2 (20 particles; noise 0.02 um, 0.05 mN). Truth: a = 1.43,",
        "effective modulus 16000 MPa, E[C1] = 7.009, E[C3^3] = 27.23, E[C5^5] = 144.2 MPa. Mean and standard deviation",
        "(over campaigns, in brackets) of the estimates; 'offset' is the paper's step at 0.2 MPa.",
        "",
        "| campaigns | offset | n | a, full objective | a, reference particle | modulus, MPa | E[C1] | E[C3^3] |"
        " E[C5^5] | spread of C3 is 0 |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    bias = {}
    for name, threshold, count, values in rows(seeds):
        mean, sd = values.mean(axis=0), values.std(axis=0, ddof=1)
        bias[name, threshold] = mean[0] - TRUE_A, sd[0], mean[1] - TRUE_A, sd[1]
        digits = (4, 4, 0, 3, 2, 1)
        cells = [f"{m:.{d}f} ({s:.{d}f})" for m, s, d in zip(mean, sd, digits, strict=False)]
        lines.append(
            f"| {name} | {'yes' if threshold else 'no'} | {count} | "
            + " | ".join(cells)
            + f" | {100 * mean[6]:.0f} % |"
        )
    exact, drawn = bias["one material, noise", 0.0], bias["C drawn from Table 2, noise", 0.2]
    step = bias["one material, noise", 0.2]
    lines += [
        "",
        "What this says:",
        "",
        f"- Without the offset step, and with one material, both objectives find a: bias {exact[0]:+.4f} (full) and"
        f" {exact[2]:+.4f} (reference).",
        f"- The offset step biases a by {step[0]:+.3f} (full) and {step[2]:+.3f} (reference): flatter particles reach"
        " 0.2 MPa at a smaller strain, and the step takes that difference away.",
        f"- With coefficients that scatter as in Table 2, one campaign of 20 gives a to +-{drawn[1]:.2f} (full)"
        f" and +-{drawn[3]:.2f} (reference). The paper's third digit, 1.43, is not determined by its 20 particles.",
        "- E[C1], E[C3^3] and E[C5^5] come from inverting the mean of strain curves. That is not the mean of the stress"
        " curves, so with scatter they are biased low; a joint posterior does not have this bias.",
        "- A spread of C3 that ends at exactly zero is common: the paper's 4.9e-9 is such a collapsed estimate.",
        "",
    ]
    return "\n".join(lines)


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--campaigns", type=int, default=200, help="campaigns with scattering coefficients")
    arguments = parser.parse_args()
    result = text(arguments.campaigns)
    print(result)
    if arguments.write:
        RESULT.parent.mkdir(exist_ok=True)
        RESULT.write_text(result, encoding="utf-8")


if __name__ == "__main__":
    main()
