"""Rows of the acceptance table, with intervals."""

from __future__ import annotations

import numpy as np
from scipy import stats

NO_GATE = "none"


def interval(hits, number, level=0.95):
    """Clopper-Pearson."""
    if number == 0:
        return (0.0, 1.0)
    tail = (1.0 - level) / 2.0
    low = 0.0 if hits == 0 else float(stats.beta.ppf(tail, hits, number - hits + 1))
    high = 1.0 if hits == number else float(stats.beta.ppf(1.0 - tail, hits + 1, number - hits))
    return low, high


class Table:
    """Rows of the acceptance table."""

    def __init__(self):
        self.rows = []

    def rate(self, metric, flags, gate, ambition, *, at_most=None, at_least=None):
        flags = [bool(flag) for flag in flags]
        number, hits = len(flags), sum(flags)
        if not number:
            self.missing(metric, gate, ambition)
            return
        value = hits / number
        low, high = interval(hits, number)
        passed = (at_most is None or value <= at_most) and (at_least is None or value >= at_least)
        self._add(
            metric,
            gate,
            ambition,
            f"{100 * value:.1f}% ({hits}/{number})",
            f"{100 * low:.1f}-{100 * high:.1f}%",
            passed,
        )

    def value(self, metric, values, gate, ambition, *, at_most=None, at_least=None, of=np.mean, unit=""):
        values = np.asarray([v for v in values if v is not None and np.isfinite(v)], dtype=float)
        if not values.size:
            self.missing(metric, gate, ambition)
            return
        observed = float(of(values))
        draws = np.random.default_rng(0).integers(0, values.size, (400, values.size))
        low, high = np.quantile([of(values[row]) for row in draws], [0.025, 0.975])
        passed = (at_most is None or observed <= at_most) and (at_least is None or observed >= at_least)
        self._add(
            metric, gate, ambition, f"{observed:.3g}{unit} (n={values.size})", f"{low:.3g}-{high:.3g}{unit}", passed
        )

    def plain(self, metric, observed, gate, ambition, passed, interval=""):
        self._add(metric, gate, ambition, observed, interval, passed)

    def missing(self, metric, gate, ambition):
        self._add(metric, gate, ambition, "not measured", "", "not measured")

    def _add(self, metric, gate, ambition, observed, spread, passed):
        if gate == NO_GATE:
            passed = "-"
        self.rows.append(
            {
                "metric": metric,
                "gate": gate,
                "ambition": ambition,
                "observed": observed,
                "95% interval": spread,
                "result": passed if isinstance(passed, str) else bool(passed),
            }
        )
