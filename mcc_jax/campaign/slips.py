"""Slips of unit and column as hypotheses: the numbers with each one undone, how likely they are, and its words.

Forces, displacements and diameters enter as logarithms, in which a wrong unit is a shift, so that all hypotheses
together cost next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .curve_features import CurveFeatures
from .plausible_ranges import PlausibilityOptions, Range

Values = np.ndarray | float


@dataclass(frozen=True)
class Slip:
    """One way in which numbers may be wrong; undoing it adds these decades to the logarithms of what was given."""

    force: float = 0.0
    displacement: float = 0.0
    diameters: tuple[float, float, float] = (0.0, 0.0, 0.0)
    swapped: bool = False
    prior: float = 0.0

    @property
    def shift(self) -> np.ndarray:
        """Decades to add to force, displacement, D1, D2 and D3."""
        return np.array([self.force, self.displacement, *self.diameters])


def hypotheses(options: PlausibilityOptions) -> list[Slip]:
    """All hypotheses, the numbers as given first."""
    slips = [Slip()]
    for decades in (-3.0, 3.0, -6.0, 6.0):
        far = options.far_slip * (abs(decades) > 3)
        one, two = options.unit_slip + far, options.unit_slip + far + options.more_slip
        slips += [Slip(force=decades, prior=one), Slip(displacement=decades, prior=one)]
        slips.append(Slip(diameters=_all(decades), prior=one))
        slips += [Slip(diameters=(d1, d2, d3), prior=two) for d1, d2, d3 in (decades * np.eye(3)).tolist()]
        slips.append(Slip(displacement=decades, diameters=_all(decades), prior=two))
        # Several columns of one file in units of one kind, for instance N and mm.
        for other in (-3.0, 3.0, -6.0, 6.0):
            far_too = options.far_slip * (abs(other) > 3)
            slips.append(Slip(force=other, displacement=decades, prior=two + far_too))
            slips.append(Slip(force=other, diameters=_all(decades), prior=two + far_too))
            three = two + far_too + options.more_slip * (not other == decades == 3)  # N and mm, as most testers write
            slips.append(Slip(force=other, displacement=decades, diameters=_all(decades), prior=three))
            if other != decades:
                slips.append(Slip(displacement=other, diameters=_all(decades), prior=two + far_too))
    slips.append(Slip(diameters=_all(float(np.log10(2))), prior=options.unit_slip))
    slips.append(Slip(swapped=True, prior=options.unit_slip))
    return slips


def _all(decades: float) -> tuple[float, float, float]:
    return decades, decades, decades


def log_numbers(features: Sequence[CurveFeatures | None], diameters_um: np.ndarray) -> np.ndarray:
    """Decades of force, displacement, D1, D2, D3 and slope, then fullness and loss, shape (N, 8)."""
    missing = (np.nan,) * 5
    rows = [
        missing if one is None else (one.force_mN, one.displacement_um, one.slope_mN_per_um, one.fullness, one.loss)
        for one in features
    ]
    force, displacement, slope, fullness, loss = np.array(rows, float).T
    return np.column_stack(
        [np.log10(force), np.log10(displacement), np.log10(diameters_um), np.log10(slope), fullness, loss]
    )


@dataclass(frozen=True)
class Apparent:
    """Decades of what a test says of its material; arrays of one shape."""

    strain: np.ndarray
    closure: np.ndarray
    stress: np.ndarray
    pressure: np.ndarray
    loading_modulus: np.ndarray
    modulus: np.ndarray

    @classmethod
    def of(cls, numbers: np.ndarray) -> Apparent:
        """From numbers as `log_numbers` gives them, shape (..., 8)."""
        force, way, d1, d2, d3, slope = (numbers[..., i] for i in range(6))
        diameter = d1 + d2 - d3
        radius = diameter - np.log10(2)
        # 1 mN / um^2 = 1000 MPa.
        return cls(
            strain=np.asarray(way - diameter),
            closure=np.asarray(way - d3),
            stress=np.asarray(force + 3 - np.log10(np.pi) - 2 * radius),
            pressure=np.asarray(force + 3 - np.log10(np.pi) - radius - way),
            # Hertz, half the displacement at each platen: F = 4/3 E sqrt(R) (gamma / 2)^1.5.
            loading_modulus=np.asarray(force + 3 + np.log10(0.75) - 0.5 * radius - 1.5 * (way - np.log10(2))),
            # Two contacts of radius a in series: S = E a, and a^2 = R gamma under full plasticity.
            modulus=np.asarray(slope + 3 - 0.5 * (radius + way)),
        )


def log_density(numbers: np.ndarray, options: PlausibilityOptions) -> np.ndarray:
    """Log density of tests under the ranges, up to a constant; -inf where nothing can be said.

    Args:
        numbers: as `log_numbers` gives them, shape (..., 8).
        options: the ranges.
    """
    it = Apparent.of(numbers)
    diameters = numbers[..., 2:5]

    def far(value: Values, within: Range) -> Values:
        low, high = in_decades(within)
        middle = (value - (low + high) / 2) / ((high - low) / 2)
        return beyond(value, low, high, options.edge) + options.tilt * np.nan_to_num(middle) ** 2

    common = sum(far(diameters[..., i], options.diameter_um) for i in range(3))
    common = common + far(numbers[..., 0], options.force_mN) + far(numbers[..., 1], options.displacement_um)
    common = common + beyond(diameters.max(-1) - diameters.min(-1), *in_decades(options.elongation), options.edge)
    common = common + beyond(it.closure, *in_decades(options.closure), options.closure_edge)
    common = common + beyond(numbers[..., 6], *options.fullness, options.fullness_edge)
    common = common + beyond(numbers[..., 7], *options.loss, options.loss_edge)
    classes = [
        far(it.modulus, solid.modulus_MPa)
        - solid.weight
        + far(it.loading_modulus, solid.loading_modulus_MPa)
        + far(it.stress, solid.stress_MPa)
        + far(it.strain, solid.strain)
        + far(it.pressure, solid.pressure_MPa)
        for solid in options.solids
    ]
    total = -(common + np.min(classes, axis=0))
    return np.where(np.isfinite(numbers[..., 0]) & np.isfinite(numbers[..., 2]), total, -np.inf)


def in_decades(within: Range) -> Range:
    """The logarithms of a range's ends, to base 10."""
    return float(np.log10(within[0])), float(np.log10(within[1]))


def beyond(value: Values, low: float, high: float, edge: float) -> Values:
    """Half the squared distance from a range in units of its edge; 0 within, and where there is no value."""
    outside = np.maximum(np.maximum(low - value, value - high), 0) / edge
    return 0.5 * np.nan_to_num(outside) ** 2


def undo(numbers: np.ndarray, swapped: np.ndarray, slips: Sequence[Slip]) -> np.ndarray:
    """The numbers of N tests with each of H slips undone.

    Args:
        numbers: as `log_numbers` gives them, shape (N, 8).
        swapped: the same with force and displacement exchanged.
        slips: the hypotheses.

    Returns:
        Numbers of shape (N, H, 8).
    """
    out = np.stack([swapped if slip.swapped else numbers for slip in slips], axis=1)
    shifts = np.array([slip.shift for slip in slips])
    out[..., :5] += shifts
    out[..., 5] += shifts[:, 0] - shifts[:, 1]
    return out


FORCE_UNITS = {-6: "nN", -3: "uN", 3: "N", 6: "kN"}
LENGTH_UNITS = {-6: "pm", -3: "nm", 3: "mm", 6: "m"}


def _columns(slip: Slip) -> list[tuple[str, int, str, str, str]]:
    """The columns that a slip concerns: what they hold, decades to add, unit they seem to hold, name, where."""
    out: list[tuple[str, int, str, str, str]] = []
    if slip.force:
        unit = FORCE_UNITS[round(slip.force)]
        out.append(("forces", round(slip.force), unit, f"force_{unit}", "curves.csv"))
    if slip.displacement:
        unit = LENGTH_UNITS[round(slip.displacement)]
        out.append(("displacements", round(slip.displacement), unit, f"displacement_{unit}", "curves.csv"))
    which = [f"D{i + 1}" for i, value in enumerate(slip.diameters) if value]
    if which:
        decades = round(max(slip.diameters, key=abs))
        unit = LENGTH_UNITS[decades]
        what = "diameters" if len(which) == 3 else f"diameters {which[0]}"
        out.append((what, decades, unit, ", ".join(f"{one}_{unit}" for one in which), "particles.csv"))
    return out


def _times(decades: int) -> str:
    return "1000 times" if abs(decades) == 3 else "a million times"


def is_radius(slip: Slip) -> bool:
    """Whether a slip is that of radii given for diameters."""
    return 0 < slip.diameters[0] < 1


def likely(slip: Slip) -> str:
    """What seems to be wrong, without a capital."""
    if slip.swapped:
        return "force and displacement seem to be swapped"
    if is_radius(slip):
        return "the diameters seem to be radii, half of what they should be"
    parts = [
        f"the {what} seem {_times(decades)} too {'large' if decades < 0 else 'small'}, as {unit} taken for"
        f" {'mN' if what == 'forces' else 'um'}"
        for what, decades, unit, _, _ in _columns(slip)
    ]
    return " and ".join(parts)


def remedy_of(slip: Slip) -> str:
    """What to write in its place."""
    if slip.swapped:
        return (
            "Exchange the columns force_mN and displacement_um in curves.csv (force and displacement in a mapping file)"
        )
    if is_radius(slip):
        return (
            "If they are radii, write twice these values into D1_um, D2_um and D3_um of particles.csv (or --diameters)"
        )
    parts: list[str] = []
    for what, decades, unit, name, file in _columns(slip):
        mapped = f'in a mapping file: unit = "{unit}"' if file == "curves.csv" else "or convert them to um"
        # The numbers may have been given in any unit; what is known is the factor.
        instead = f"in place of another unit, take the one {_times(decades)} {'smaller' if decades < 0 else 'larger'}"
        parts.append(
            f"if the {what} are in {unit}, name the column{'s' if ',' in name else ''} {name} in {file}"
            f" ({mapped}; {instead})"
        )
    text = "; ".join(parts)
    return text[0].upper() + text[1:]
