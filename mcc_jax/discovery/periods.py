"""What repeats with travel, force or time: its period, by a periodogram of what the law leaves.

Bretthorst (1988), Bayesian Spectrum Analysis and Parameter Estimation, Lecture Notes in Statistics 48. A cosine and a
sine of unknown amplitudes and frequency are compared with the law alone, whose numbers are integrated out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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

# Coordinates of every point, each with the displacement that an error of 1 there makes: of force there are two, the
# reading's own and the one from which its branch starts.
Errors = Sequence[tuple[np.ndarray, np.ndarray | float]]


@dataclass(frozen=True)
class Periodogram:
    """Sinusoids of one coordinate against the law alone."""

    coordinate: str
    frequency: np.ndarray  # periods per unit of the coordinate
    power: np.ndarray  # log likelihood ratio of cosine and sine together
    information: np.ndarray  # on either amplitude [1/um^2]
    best: float  # the likeliest frequency
    errors: Errors = ()  # what repeats, at the tests
    unit: float = 1.0  # displacement that an error of 1 makes, root mean square over the tests [um]

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

    def columns(self, errors: Errors) -> np.ndarray:
        """Sinusoids of the likeliest period and its harmonics, with a variance of 1 together [um]."""
        order = np.arange(1, HARMONICS + 1)
        return sinusoids(self.best * order, errors) / np.tile(order, 2) / (self.unit * np.sqrt(np.sum(order**-2.0)))


def sinusoids(frequency: np.ndarray, errors: Errors) -> np.ndarray:
    """Cosines of some frequencies, then sines."""
    total: np.ndarray | float = 0.0
    for x, weight in errors:
        angle = 2 * np.pi * frequency * x[..., None]
        total = total + np.concatenate([np.cos(angle), np.sin(angle)], -1) * np.asarray(weight)[..., None]
    return np.asarray(total)


def _errors_along(natural: Mapping[str, np.ndarray], null: Fitted) -> dict[str, Errors]:
    """What may repeat: errors of the instrument along its travel [um], its force [mN] and time [s]; and what particles
    do, in proportion to their size, along their travel over the diameter and their largest strain so far."""
    tests, linear = null.design.tests, null.design.linear
    by_force, by_peak = (np.where(tests.mask, x, 0.0) for x in (linear.by_force, linear.by_peak))
    found: dict[str, Errors] = {name: [(natural[name], 1.0)] for name in ("drive", "clock") if name in natural}
    found["force"] = [(natural["force"], by_force), (natural["peak_force"], by_peak)]
    size = np.asarray(tests.effective_diameter)[:, None]
    return found | {name: [(natural[name], size)] for name in ("travel", "strain")}


def periodograms(natural: Mapping[str, np.ndarray], null: Fitted) -> tuple[Periodogram, ...]:
    """Those of every coordinate along which something may repeat, where tests say anything of it."""
    mask = np.asarray(null.design.tests.mask)
    found = (_periodogram(name, errors, mask, null) for name, errors in _errors_along(natural, null).items())
    return tuple(one for one in found if one is not None)


def _periodogram(name: str, errors: Errors, mask: np.ndarray, null: Fitted) -> Periodogram | None:
    x = errors[0][0]
    unit = float(np.sqrt(np.mean(sum(np.broadcast_to(weight, x.shape)[mask] ** 2 for _, weight in errors))))
    span, step = np.ptp(x[mask]), np.abs(np.diff(x))[mask[:, 1:] & mask[:, :-1]]
    fastest = 1 / (READINGS * max(float(np.median(step[step > 0])), 1e-300)) if np.any(step > 0) else 0.0
    apart = 1 / (OVERSAMPLED * max(span, 1e-300))  # frequencies from each other
    frequency = apart * np.arange(LEAST_PERIODS * OVERSAMPLED, MOST)
    frequency = frequency[frequency <= fastest]
    if not (len(frequency) and unit > 0):
        return None
    of_unit = [(x, weight / unit) for x, weight in errors]
    power, information = _against_law(frequency, of_unit, mask, null)
    near = frequency[np.argmax(power)] + np.linspace(-1, 1, REFINED) * apart
    best = near[np.argmax(_against_law(near, of_unit, mask, null)[0])]
    return Periodogram(name, frequency, power, information, float(best), errors, unit)


def _against_law(
    frequency: np.ndarray, errors: Errors, mask: np.ndarray, null: Fitted
) -> tuple[np.ndarray, np.ndarray]:
    """Log likelihood ratio of cosine and sine of each frequency, and information on either amplitude."""
    power, information = [], []
    for some in np.array_split(frequency, -(-len(frequency) // AT_ONCE)):
        columns = np.where(mask[..., None], sinusoids(some, errors), 0.0)
        shared = LinearModel(null.optimum.hyper, null.design.with_amplitudes(columns)).shared()
        both = np.arange(len(some))[:, None] + [0, len(some)]
        inner = shared.information[both[:, :, None], both[:, None, :]] + 1e-9 * np.eye(2)
        score = shared.score[both]
        power.append(0.5 * np.sum(score * np.linalg.solve(inner, score[..., None])[..., 0], 1))
        information.append(np.sqrt(np.maximum(np.linalg.det(inner), 0.0)))
    return np.concatenate(power), np.concatenate(information)
