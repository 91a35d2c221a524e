"""What repeats with travel or with time: its period, by a periodogram of what the law leaves.

Bretthorst (1988), Bayesian Spectrum Analysis and Parameter Estimation, Lecture Notes in Statistics 48. A cosine and a
sine of unknown amplitudes and frequency are compared with the law alone, whose numbers are integrated out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from .evidence import LinearModel
from .fit import Fitted

LEAST_PERIODS = 2.0  # over the range; what is slower is no repetition that these tests can show
READINGS = 4.0  # of a period at least: half as many are the limit of Nyquist
MOST = 256  # frequencies tried of one coordinate
OVERSAMPLED = 2.0  # frequencies per independent one: the power halfway between two of them stays above 0.8
REFINED = 9  # finer ones around the best
HARMONICS = 2  # of a repetition that is no sinusoid; amplitudes as 1 / order
AT_ONCE = 32  # frequencies whose information is worked out together


@dataclass(frozen=True)
class Periodogram:
    """Sinusoids of one coordinate against the law alone."""

    coordinate: str
    frequency: np.ndarray  # periods per unit of the coordinate
    power: np.ndarray  # log likelihood ratio of cosine and sine together
    information: np.ndarray  # on either amplitude [1/um^2]
    best: float  # the likeliest frequency

    def log_ratios(self, sizes: np.ndarray, power: np.ndarray) -> np.ndarray:
        """Log evidence of each frequency in campaigns of some powers; sds of the amplitudes are one of `sizes` [um]."""
        strength = sizes[:, None, None] ** 2 * self.information
        each = power * strength / (1 + strength) - np.log1p(strength)
        return np.asarray(logsumexp(each, axis=0)) - np.log(len(sizes))

    def log_ratio(self, sizes: np.ndarray, power: np.ndarray) -> np.ndarray:
        """The same of a sinusoid of unknown frequency."""
        return np.asarray(logsumexp(self.log_ratios(sizes, power), axis=1)) - np.log(len(self.frequency))

    def of_choice(self, sizes: np.ndarray) -> float:
        """What having chosen the likeliest frequency costs in log evidence."""
        return float(self.log_ratio(sizes, self.power[None])[0] - np.max(self.log_ratios(sizes, self.power[None])))

    def columns(self, x: np.ndarray) -> np.ndarray:
        """Sinusoids of the likeliest period and its harmonics, with a variance of 1 together [um]."""
        order = np.arange(1, HARMONICS + 1)
        angle = 2 * np.pi * self.best * order * x[..., None]
        found = np.concatenate([np.cos(angle) / order, np.sin(angle) / order], -1)
        return found / np.sqrt(np.sum(order**-2.0))


def periodograms(natural: Mapping[str, np.ndarray], null: Fitted) -> tuple[Periodogram, ...]:
    """Those of the drive's travel [um] and of time [s], where tests say anything of them."""
    mask = np.asarray(null.design.tests.mask)
    found = (_periodogram(name, natural[name], mask, null) for name in ("drive", "clock") if name in natural)
    return tuple(one for one in found if one is not None)


def _periodogram(name: str, x: np.ndarray, mask: np.ndarray, null: Fitted) -> Periodogram | None:
    span, step = np.ptp(x[mask]), np.abs(np.diff(x))[mask[:, 1:] & mask[:, :-1]]
    fastest = 1 / (READINGS * max(float(np.median(step)), 1e-300))
    apart = 1 / (OVERSAMPLED * max(span, 1e-300))  # frequencies from each other
    frequency = apart * np.arange(LEAST_PERIODS * OVERSAMPLED, MOST)
    frequency = frequency[frequency <= fastest]
    if not len(frequency):
        return None
    power, information = _against_law(frequency, x, mask, null)
    near = frequency[np.argmax(power)] + np.linspace(-1, 1, REFINED) * apart
    best = near[np.argmax(_against_law(near, x, mask, null)[0])]
    return Periodogram(name, frequency, power, information, float(best))


def _against_law(frequency: np.ndarray, x: np.ndarray, mask: np.ndarray, null: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Log likelihood ratio of cosine and sine of each frequency, and information on either amplitude."""
    power, information = [], []
    for some in np.array_split(frequency, -(-len(frequency) // AT_ONCE)):
        angle = 2 * np.pi * some * x[..., None]
        columns = np.where(mask[..., None], np.concatenate([np.cos(angle), np.sin(angle)], -1), 0.0)
        shared = LinearModel(null.optimum.hyper, null.design.with_amplitudes(columns)).shared()
        both = np.arange(len(some))[:, None] + [0, len(some)]
        inner = shared.information[both[:, :, None], both[:, None, :]] + 1e-9 * np.eye(2)
        score = shared.score[both]
        power.append(0.5 * np.sum(score * np.linalg.solve(inner, score[..., None])[..., 0], 1))
        information.append(np.sqrt(np.maximum(np.linalg.det(inner), 0.0)))
    return np.concatenate(power), np.concatenate(information)
