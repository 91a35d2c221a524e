r"""Whether numbers can be those of a compressed particle; if not, which slip of unit, sign or column explains them.

Every test gives four numbers that no unit enters twice: the size D_e, the stress :math:`\sigma = F / (\pi R_e^2)` and
the strain :math:`\epsilon = d / D_e` at the largest force, and the modulus that an elastic sphere between two plates
would need for them,

.. math:: E_H = \frac{3 \pi}{4} \frac{\sigma}{\epsilon^{3/2}}

(Hertz: two contacts of approach d/2 each). A real particle yields and breaks, so it is softer than that: E_H is below
the material's own modulus, and nothing is stiffer than diamond. A campaign is judged by the median over its particles.
Numbers inside the ranges are never accused. Outside, every slip that would bring them back inside is weighed by how
usual the mended numbers are, and the likeliest one is named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ._schema import Campaign, Curve
from .findings import Finding

CHECK = "plausibility"


@dataclass(frozen=True)
class PlausibilityOptions:
    """Ranges of solids. They are wide on purpose: what lies outside is no material that a tester of particles presses.

    Attributes:
        diameter_um: effective diameter [um]: from what an optical microscope resolves to what is no particle any more.
        stress_MPa: nominal stress at the largest force [MPa]. Below 0.1 MPa only asperities deform (the paper's
            threshold is 0.2 MPa); above 3 GPa no solid of such a size holds together (Ashby, Materials Selection in
            Mechanical Design, 5th ed. 2017, fig. 4.4: strength of technical ceramics in compression up to 5 GPa of the
            material, of which a loaded sphere's cross-section bears a part).
        light_strain: a particle that is compressed by less is only touched, and may bear less than the least stress.
        small_um: particles below this diameter may bear
        small_stress_MPa: so much: few micrometres of glass are nearly free of flaws (Romeis et al. 2015, Powder
            Technol. 270, 337: nominal stresses up to 10 GPa).
        strain: at the largest force [-]: platens that come together by more than 0.6 of the diameter leave no
            particle to speak of; the paper's go to 0.5.
        hertz_MPa: modulus by Hertz [MPa]: from rubber (Ashby, fig. 4.3: 1 MPa, and less by yielding) to diamond.
        modulus_MPa: fitted effective modulus [MPa]: the same materials. The effective modulus is E/(1 - nu^2).
        cellulose_GPa: modulus of what is called cellulose here [GPa]; outside it is said that this may be another
            material, which accuses nobody.
        usual: logarithm (base 10) of size [um], stress [MPa], strain and Hertz modulus [MPa] of tests in the
            literature, mean and standard deviation: pharmaceutical powders, polymers, ceramics and metals together.
        alike: slips are both named if their log likelihoods differ by less [-]: a ratio of 1 to 7.
        own_decades: a particle is judged by itself if it is so many powers of ten from the median of the others.
    """

    diameter_um: tuple[float, float] = (0.5, 2e4)
    stress_MPa: tuple[float, float] = (0.1, 3e3)
    light_strain: float = 2e-3
    small_um: float = 20.0
    small_stress_MPa: float = 2e4
    strain: tuple[float, float] = (2e-5, 0.6)
    hertz_MPa: tuple[float, float] = (0.2, 1.2e6)
    modulus_MPa: tuple[float, float] = (1.0, 1.3e6)
    cellulose_GPa: tuple[float, float] = (1.0, 40.0)
    usual: tuple[tuple[float, float], ...] = ((2.4, 0.6), (1.3, 0.8), (-0.9, 0.6), (3.3, 1.0))
    alike: float = 2.0
    own_decades: float = 2.0


@dataclass(frozen=True)
class Slip:
    """A mistake that a person can make, and what undoes it.

    Attributes:
        words: what was done, as the end of "probably ...".
        remedy: what to do.
        force, displacement, diameter: factors that undo it.
        swap: whether force and displacement stand in each other's column.
    """

    words: str
    remedy: str
    force: float = 1.0
    displacement: float = 1.0
    diameter: float = 1.0
    swap: bool = False


def _slips() -> tuple[Slip, ...]:
    found = []
    for name, symbol, smaller, larger in (
        ("force", "mN", "uN", "N"),
        ("displacement", "um", "nm", "mm"),
        ("diameter", "um", "nm", "mm"),
    ):
        column = "D1, D2, D3" if name == "diameter" else f"the {name} column"
        verb = "are" if name == "diameter" else "is"
        for factor, unit in ((1e-3, smaller), (1e3, larger)):
            words = f"{column} {verb} in {unit} and called {symbol} (or off by {1 / factor:g} in another way)"
            remedy = f"Name the unit as it is: _{unit} instead of _{symbol} in the header, or unit in the mapping file"
            undo = {other: factor if other == name else 1.0 for other in ("force", "displacement", "diameter")}
            found.append(Slip(words, remedy, undo["force"], undo["displacement"], undo["diameter"]))
    found.append(
        Slip("radii are given for the diameters", "Enter diameters: D1, D2, D3 are twice the radii", diameter=2.0)
    )
    found.append(Slip("force and displacement stand in each other's column", "Swap the two columns' names", swap=True))
    return tuple(found)


SLIPS = _slips()


def check_plausibility(
    campaign: Campaign, *, modulus_MPa: float | None = None, options: PlausibilityOptions | None = None
) -> tuple[Finding, ...]:
    """What cannot be true of the numbers of a campaign, with the likely slip; empty where all can.

    Args:
        campaign: the tests, raw or checked.
        modulus_MPa: a fitted effective modulus, where there is one [MPa].
        options: the ranges.
    """
    options = options or PlausibilityOptions()
    found = wrong_signs(campaign)
    if not found:
        found += _sizes(campaign, options)
    if not found:
        found += _shapes(campaign)
    if modulus_MPa is not None and not any(f.level == "bad" for f in found):
        found += _modulus(modulus_MPa, options)
    return tuple(found)


# ---- signs -----------------------------------------------------------------------------------------------------------


def _directions(curve: Curve) -> tuple[int, int]:
    """Whether the load goes to positive force, and whether displacement grows while the load does; 0 for unclear."""
    force, path = np.asarray(curve.force_mN, float), np.asarray(curve.displacement_um, float)
    rest = float(np.median(np.sort(np.abs(force))[: max(len(force) // 20, 1)]))
    up, down = float(force.max()) - rest, -float(force.min()) - rest
    if max(up, down) <= 0:
        return 0, 0
    sign = 1 if up > 3 * down else -1 if down > 3 * up else 0
    if sign == 0:
        return 0, 0
    load = sign * force
    top = int(np.argmax(load))
    start = int(np.argmax(load > 0.1 * load[top]))
    # On loading; a record without any is looked at on unloading.
    rising = slice(start, top + 1) if top - start >= 5 else slice(top, len(load))
    if len(load[rising]) < 6:
        return sign, 0
    moved = np.polynomial.Polynomial.fit(load[rising], path[rising], 1).convert().coef
    slope = float(moved[1]) if len(moved) > 1 else 0.0
    change = abs(slope) * float(np.ptp(load[rising]))
    scatter = float(np.median(np.abs(np.diff(path)))) if len(path) > 2 else 0.0
    return sign, 0 if change <= 3 * scatter else int(np.sign(slope))


def wrong_signs(campaign: Campaign) -> list[Finding]:
    """A finding if force, displacement or both are counted the other way round in most tests; else none."""
    seen = [_directions(curve) for curve in campaign.curves]
    count = len(seen)
    negative = [n for n, (force, _) in zip(campaign.particles, seen, strict=True) if force < 0]
    apart = [n for n, (_, way) in zip(campaign.particles, seen, strict=True) if way < 0]
    if len(negative) * 2 <= count and len(apart) * 2 <= count:
        return []
    remedy = "Turn the sign round: sign = -1 in the mapping file, or multiply the column by -1"
    if len(negative) * 2 > count:
        away = [n for n, (force, way) in zip(campaign.particles, seen, strict=True) if force < 0 and way < 0]
        if len(away) * 2 > count:
            text = (
                "force and displacement are both negative where the particle is pressed: probably the tester counts "
                "compression as negative"
            )
            return [Finding(CHECK, "bad", text, f"{remedy}, of both")]
        text = "force is negative where the particle is pressed: probably the tester counts compression as negative"
        return [Finding(CHECK, "bad", text, f"{remedy} of force")]
    text = (
        "displacement falls while the force rises: probably it is counted the other way round, as the gap between the "
        "platens or a position"
    )
    return [Finding(CHECK, "bad", text, f"{remedy} of displacement")]


# ---- sizes of the numbers --------------------------------------------------------------------------------------------


def _numbers(campaign: Campaign) -> np.ndarray:
    """Largest force [mN], displacement there [um] and diameter [um] of every particle, (N, 3); NaN where unclear."""
    rows = []
    for curve, (D1, D2, D3) in zip(campaign.curves, np.asarray(campaign.diameters_um, float), strict=True):
        force, path = np.asarray(curve.force_mN, float), np.asarray(curve.displacement_um, float)
        top = int(np.argmax(force))
        # From where the force begins to rise; a campaign whose zero is the contact begins there.
        rising = np.flatnonzero(force[: top + 1] <= force[: top + 1].min() + 0.02 * np.ptp(force[: top + 1]))
        start = int(rising[-1]) if len(rising) else 0
        travel = float(path[: top + 1].max() - path[start]) if top > start else np.nan
        rows.append((float(force[top] - min(force[start], 0.0)), travel, D1 * D2 / D3))
    found = np.array(rows, float)
    return np.where(found > 0, found, np.nan)


def _features(numbers: np.ndarray, slip: Slip | None = None) -> np.ndarray:
    """Log10 of size [um], stress [MPa], strain [-] and Hertz modulus [MPa], after a slip is undone; shape (..., 4)."""
    force, path, size = (numbers[..., i] for i in range(3))
    if slip is not None:
        force, path = (path, force) if slip.swap else (force, path)
        force, path, size = force * slip.force, path * slip.displacement, size * slip.diameter
    stress = 1e3 * force / (np.pi * size**2 / 4)
    strain = path / size
    return np.log10(np.stack([size, stress, strain, 0.75 * np.pi * stress / strain**1.5], axis=-1))


def _outside(features: np.ndarray, options: PlausibilityOptions) -> np.ndarray:
    """Which of the four numbers lie outside their ranges, booleans of shape (4,)."""
    size = 10 ** features[0]
    least, most = options.stress_MPa
    most = options.small_stress_MPa if size < options.small_um else most
    least = least if 10 ** features[2] > options.light_strain else 0.0
    ranges = (options.diameter_um, (least, most), options.strain, options.hertz_MPa)
    return np.array([not low <= 10**value <= high for value, (low, high) in zip(features, ranges, strict=True)])


def _sizes(campaign: Campaign, options: PlausibilityOptions) -> list[Finding]:
    numbers = _numbers(campaign)
    known = np.isfinite(numbers).all(axis=1)
    if not known.any():
        return []
    backwards = _backwards(campaign)
    typical = np.nanmedian(np.log10(numbers[known]), axis=0)
    finding = _judged(10**typical, options, backwards)
    if finding is not None:
        return [finding]
    # One particle's row may have slipped although the campaign as a whole is fine.
    found = []
    features = _features(numbers)
    middle = np.nanmedian(features, axis=0)
    if known.sum() >= 3:
        for i in np.flatnonzero(known):
            if np.max(np.abs(features[i] - middle)[[0, 2, 3]]) > options.own_decades:
                own = _judged(numbers[i], options, False) or _judged(numbers[i], options, False, middle)
                if own is not None:
                    name = campaign.particles[i]
                    found.append(replace(own, sentence=f"particle {name}: {own.sentence}", particles=(name,)))
    return found[:5]


def _judged(
    numbers: np.ndarray, options: PlausibilityOptions, backwards: bool, middle: np.ndarray | None = None
) -> Finding | None:
    """The finding for three numbers, None if they lie inside the ranges (or near the middle of the others)."""
    features = _features(numbers)
    outside = _outside(features, options)
    if not outside.any() and not backwards and middle is None:
        return None
    means, sds = (np.array(column) for column in zip(*options.usual, strict=True))
    if middle is not None:
        means, sds = middle, np.full(4, 0.3)
    ranked = []
    for slip in SLIPS:
        if backwards and not slip.swap:
            continue
        mended = _features(numbers, slip)
        if not _outside(mended, options).any():
            ranked.append((float(-0.5 * np.sum(((mended - means) / sds) ** 2)), slip))
    ranked.sort(key=lambda pair: -pair[0])
    seen = _seen(features, outside)
    if not ranked:
        if middle is not None:
            return None
        remedy = "Check the units and the signs of all columns, and the diameters"
        return Finding(CHECK, "bad", f"{seen}: no solid does that, and no single slip of a unit explains it", remedy)
    best, slip = ranked[0]
    others = [other for value, other in ranked[1:2] if best - value < options.alike]
    words = " or ".join(one.words for one in [slip, *others])
    return Finding(CHECK, "bad", f"{seen}: probably {words}", slip.remedy)


def _seen(features: np.ndarray, outside: np.ndarray) -> str:
    size, stress, strain, hertz = (float(10**v) for v in features)
    texts = (
        f"a particle of {_si(size, 'um', (('mm', 1e-3), ('nm', 1e3)))}",
        f"a stress of {_si(stress, 'MPa', (('GPa', 1e-3), ('kPa', 1e3)))}",
        f"a compression by {100 * strain:.3g} % of the diameter",
        f"a contact as stiff as of a modulus of {_si(hertz, 'MPa', (('GPa', 1e-3), ('kPa', 1e3)))}",
    )
    told = [text for text, out in zip(texts, outside, strict=True) if out]
    return "the tests show " + " and ".join(told or ["an unloading that gives back more than the loading took"])


def _si(value: float, unit: str, others: tuple[tuple[str, float], ...]) -> str:
    (large, up), (small, down) = others
    if value >= 1e3:
        return f"{value * up:.3g} {large}"
    return f"{value * down:.3g} {small}" if value < 0.1 else f"{value:.3g} {unit}"


def _backwards(campaign: Campaign) -> bool:
    """Whether most tests give back more work than they took, as they do with force and displacement swapped."""
    signs = []
    for curve in campaign.curves:
        force, path = np.asarray(curve.force_mN, float), np.asarray(curve.displacement_um, float)
        top = int(np.argmax(force))
        if top < 8 or len(force) - top < 8 or force[-1] > 0.5 * force[top]:
            continue
        steps = np.diff(path)
        level = (force[1:] + force[:-1]) / 2 - force.min()
        taken, given = float(np.sum(level[:top] * steps[:top])), float(-np.sum(level[top:] * steps[top:]))
        if taken > 0:
            signs.append(given > 1.1 * taken)
    return len(signs) >= 3 and float(np.mean(signs)) > 0.8


def _shapes(campaign: Campaign) -> list[Finding]:
    """Whether D3, along the compression, is the largest diameter of nearly every particle."""
    D1, D2, D3 = np.asarray(campaign.diameters_um, float).T
    largest = np.maximum(D1, D2)
    if len(D3) >= 5 and np.mean(1.05 * largest < D3) > 0.8:
        text = (
            "D3 is the largest diameter of nearly every particle, though particles come to rest on their flat side: "
            "probably the columns of the diameters are in another order"
        )
        return [Finding(CHECK, "look", text, "Let D3 be the diameter along the compression")]
    return []


def _modulus(value: float, options: PlausibilityOptions) -> list[Finding]:
    if not np.isfinite(value):
        return []
    low, high = options.modulus_MPa
    if not low <= value <= high:
        text = f"the fitted modulus of {_si(value, 'MPa', (('GPa', 1e-3), ('kPa', 1e3)))} is that of no solid"
        return [Finding(CHECK, "bad", text, "Look at the unloading of the tests, and at the units of all columns")]
    low, high = options.cellulose_GPa
    if not low <= value / 1e3 <= high:
        text = (
            f"the fitted modulus of {value / 1e3:.3g} GPa is not that of cellulose ({low:g} to {high:g} GPa); of "
            "another material it may well be, but the priors are those of cellulose"
        )
        return [Finding(CHECK, "told", text, "")]
    return []
