"""The numbers behind the page "Which test shows which effect": what each of seven plans could show.

    uv run python .docs/make_power.py

Writes `power.json` next to this file, in about six minutes. It is stored because the pages must build in two. Each plan
is simulated with the paper's twenty particles and an instrument of stated noise; `mcc_jax.discovery.power_of_campaign`
calculates the detection limits. A test in `tests/docs/test_gallery.py` computes one plan again.
"""

import json
import re
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import mcc_jax as mcc
from mcc_jax.campaign import join_campaigns
from mcc_jax.discovery import power_of_campaign

FILE = Path(__file__).parent / "power.json"
NOISE = {"displacement_noise_um": 0.05, "force_noise_mN": 0.05}
POINTS = 150
RATE_MN_PER_S = 2.0
RISING = {"levels": (0.5, 1.0, 1.0), "unload_to": 0.3, "hold_s": 20.0}


def cycles(rate=RATE_MN_PER_S, **what):
    """Load and unload; everything else is given by keyword."""
    return mcc.Programme.cycles(rate=rate, points=POINTS, **what)


def tests(programme, **more):
    """The paper's twenty particles under a programme; the same particles and the same noise for every plan."""
    return mcc.paper_campaign(0, programme=programme, instrument=mcc.Instrument(**NOISE), **more)


def two_rates(**more):
    """Every second particle ten times faster."""
    slow, fast = tests(cycles(**RISING), **more), tests(cycles(rate=10 * RATE_MN_PER_S, **RISING), **more)
    even = np.arange(len(slow)) % 2 == 0
    return join_campaigns(slow.select(even), fast.select(~even))


PLANS = {
    "load": ("Load only", lambda: tests(mcc.Programme("load", (mcc.Ramp(1.0, RATE_MN_PER_S),), None, POINTS))),
    "unload": ("Load, unload", lambda: tests(cycles())),
    "hold": ("Load, hold, unload", lambda: tests(cycles(hold_s=20.0))),
    "reload": ("Load, unload, reload", lambda: tests(cycles(levels=(1.0, 1.0), unload_to=0.3))),
    "rising": ("Rising peaks, holds, reloads", lambda: tests(cycles(**RISING))),
    "rates": ("The same, two rates", two_rates),
    "humidity": (
        "The same, three humidities",
        lambda: two_rates(relative_humidity_percent=np.array([20.0, 45.0, 70.0])[np.arange(20) % 3]),
    ),
}
"""By name: the title of its column, and the tests. The plans become richer from left to right."""


def worked_out(name):
    """The entry of a plan in `power.json`."""
    title, make = PLANS[name]
    found = power_of_campaign(make()).to_json()
    limits = {m["mechanism"]: float(f"{m['detection_limit']:.3g}") for m in found["mechanisms"]}
    alike = [[*pair["pair"], round(pair["similarity"], 3)] for pair in found["inseparable"]]
    return {
        "title": title,
        "limits": limits,
        "alike": alike,
        "needs": {u["mechanism"]: u["needs"] for u in found["untestable"]},
    }


if __name__ == "__main__":
    plans = {}
    for plan in PLANS:
        plans[plan] = worked_out(plan)
        print(plan, flush=True)
    content = {"particles": 20, "points": POINTS, **NOISE, "rate_mN_per_s": RATE_MN_PER_S, "plans": plans}
    text = json.dumps(content, indent=1, ensure_ascii=False)
    text = re.sub(r"\[([^\[\]]*)\]", lambda pair: f"[{' '.join(pair[1].split())}]", text)  # each pair in one line
    FILE.write_text(text + "\n", encoding="utf-8")
