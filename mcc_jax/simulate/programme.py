"""What the instrument does, ramps, holds and cycles, and how it reads the truth: noise, resolution, a zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described, number, percent, table
from ..campaign import Control, load_toml_file


@dataclass(frozen=True)
class Ramp:
    """Go to a level at a constant rate.

    Attributes:
        to: level as a share of the particle's peak; 1 is the peak, 0 full release.
        rate: mN/s under load control, um/s under displacement control, > 0.
    """

    to: float
    rate: float

    def __post_init__(self) -> None:
        level = "the level that a ramp goes to, a share of the peak,"
        object.__setattr__(self, "to", arguments.number(self.to, level, least=0))
        object.__setattr__(self, "rate", arguments.number(self.rate, "the rate of a ramp", above=0))


@dataclass(frozen=True)
class Hold:
    """Stay where you are for so many seconds, > 0."""

    seconds: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "seconds", arguments.number(self.seconds, "the duration of a hold [s]", above=0))


@dataclass(frozen=True)
class Programme:
    """A sequence of ramps and holds, starting from zero.

    Exactly one of `interval_s` and `points` says how densely it is sampled. Turning points are always sampled.

    Attributes:
        control: the controlled quantity, "load" or "displacement".
        steps: the ramps and holds.
        interval_s: time between two samples [s]; particles then get curves of unequal length.
        points: number of samples, evenly spread over the time of the test (the turning points come on top).
    """

    control: Control
    steps: Sequence[Ramp | Hold]
    interval_s: float | None = None
    points: int | None = None

    def __post_init__(self) -> None:
        if (self.interval_s is None) == (self.points is None):
            raise InputError("give exactly one of interval_s and points")
        if self.points is None:
            object.__setattr__(self, "interval_s", arguments.number(self.interval_s, "interval_s", above=0))
        else:
            object.__setattr__(self, "points", arguments.whole(self.points, "points", least=2))
        arguments.choice(self.control, get_args(Control), "control")
        if not self.steps:
            raise InputError("a programme needs at least one step")
        object.__setattr__(self, "steps", tuple(self.steps))

    def __repr__(self) -> str:
        unit = "mN/s" if self.control == "load" else "um/s"
        sampling = f"every {self.interval_s} s" if self.points is None else f"{self.points} samples"
        rows = []
        for i, step in enumerate(self.steps, start=1):
            if isinstance(step, Hold):
                rows.append((str(i), f"hold {number(step.seconds)} s"))
            else:
                rows.append((str(i), f"to {percent(step.to)} of the peak at {number(step.rate)} {unit}"))
        return table(f"Programme under control of {self.control}, {sampling}", rows)

    @classmethod
    def cycles(
        cls,
        *,
        control: Control = "load",
        rate: float = 2.0,
        levels: Sequence[float] = (1.0,),
        unload_to: float = 0.0,
        hold_s: float = 0.0,
        interval_s: float | None = None,
        points: int | None = None,
    ) -> Programme:
        """Load to each level in turn and unload after each; the last unloading is complete.

        Args:
            rate: of all ramps [mN/s or um/s]; the paper's tests ran at 2 mN/s, which it calls a stress rate.
            levels: shares of the particle's peak, one per cycle.
            unload_to: share of the peak at which reloading starts.
            hold_s: hold at every level.
            control, interval_s, points: as of `Programme`; 300 points if neither is given.
        """
        levels = arguments.floats(levels, "levels", shape="a list of shares of the peak").ravel().tolist()
        hold_s = arguments.number(hold_s, "hold_s", least=0)
        unload_to = arguments.number(unload_to, "unload_to, a share of the peak,", least=0)
        hold = [Hold(hold_s)] if hold_s else []
        steps: list[Ramp | Hold] = []
        for i, level in enumerate(levels, start=1):
            steps += [Ramp(level, rate), *hold, Ramp(unload_to if i < len(levels) else 0.0, rate)]
        if interval_s is None and points is None:
            points = 300
        return cls(control, steps, interval_s, points)

    def sample(self, peak: float) -> tuple[np.ndarray, np.ndarray]:
        """Times [s], strictly increasing, and target values (mN or um) for a particle whose peak is `peak`."""
        peak = arguments.number(peak, "the peak of a particle [mN or um]", above=0)
        times, values = [0.0], [0.0]
        for step in self.steps:
            value = values[-1] if isinstance(step, Hold) else step.to * peak
            duration = step.seconds if isinstance(step, Hold) else abs(value - values[-1]) / step.rate
            # A billionth of the time so far is no step: rounding of the times alone would change its rate. Nor is a
            # picosecond at the beginning: sampled, it would fall below the smallest number.
            if duration > max(1e-9 * times[-1], 1e-12):
                times.append(times[-1] + duration)
                values.append(value)
        if len(times) < 2:
            raise InputError("the programme never leaves zero")
        interval = self.interval_s or times[-1] / ((self.points or 2) - 1)
        grid = np.arange(0.0, times[-1], interval)
        # A grid point that falls onto a turning point but for rounding would make two samples of one.
        near = np.abs(grid[:, None] - np.asarray(times)[None, :]).min(axis=1) < 1e-6 * interval
        time = np.sort(np.concatenate([grid[~near], times]))
        return time, np.interp(time, times, values)


@dataclass(frozen=True)
class Instrument:
    """Read-out of an instrument; the default is perfect.

    Attributes:
        displacement_noise_um, force_noise_mN: standard deviation of white noise.
        displacement_resolution_um, force_resolution_mN: smallest step of the read-out; 0 for none.
        zero_um: standard deviation of each test's zero of displacement, where the instrument found contact.
    """

    displacement_noise_um: float = 0.0
    force_noise_mN: float = 0.0
    displacement_resolution_um: float = 0.0
    force_resolution_mN: float = 0.0
    zero_um: float = 0.0

    __repr__ = described()

    def __post_init__(self) -> None:
        for name, value in list(vars(self).items()):
            object.__setattr__(self, name, arguments.number(value, name, least=0))

    def read(
        self, rng: np.random.Generator, force_mN: np.ndarray, displacement_um: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Force [mN] and displacement [um] as recorded, from the true ones, shapes (n,)."""
        n = len(force_mN)
        # All draws are made whatever the settings, so that switching one effect on leaves the others' draws alone.
        zero, displacement_noise, force_noise = rng.standard_normal(), rng.standard_normal(n), rng.standard_normal(n)
        displacement = displacement_um + self.zero_um * zero + self.displacement_noise_um * displacement_noise
        force = force_mN + self.force_noise_mN * force_noise
        return _rounded(force, self.force_resolution_mN), _rounded(displacement, self.displacement_resolution_um)


def _rounded(values: np.ndarray, step: float) -> np.ndarray:
    return np.round(values / step) * step if step else values


def read_programme(file: str | Path) -> Programme:
    """Read a programme from a TOML file, as in the example of `mcc-jax simulate --help`."""
    file = arguments.file_path(file, "file")
    entries = load_toml_file(file)
    known = ("control", "rate", "points", "interval_s", "step")
    where = "the programme"
    try:
        for key in entries.keys() - set(known):
            raise InputError(f"unknown entry {key!r}", remedy=f"Known: {', '.join(known)}.")  # noqa: TRY301
        if not isinstance(entries.get("step"), list):
            raise InputError("has no [[step]]")  # noqa: TRY301
        steps: list[Ramp | Hold] = []
        for i, entry in enumerate(entries["step"], start=1):
            where = f"step {i}"
            steps.append(_step(entry, entries.get("rate")))
        where = "the programme"
        control = arguments.choice(entries.get("control", "load"), get_args(Control), "control")
        interval_s = arguments.number(entries["interval_s"], "interval_s") if "interval_s" in entries else None
        points = entries.get("points", 300 if interval_s is None else None)
        return Programme(control, steps, interval_s, None if points is None else arguments.whole(points, "points"))
    except InputError as error:
        remedy = error.remedy or "See the example in `mcc-jax simulate --help`."
        raise InputError(f"{where}: {error.problem}", file=file, remedy=remedy) from None


def _step(entry: Any, rate: Any) -> Ramp | Hold:
    """A step of a programme's file."""
    match entry:
        case {"ramp_to": to, **rest} if rest.keys() <= {"rate"}:
            rate = arguments.number(rest.get("rate", rate), "rate, of the step or of all at the top,")
            return Ramp(arguments.number(to, "ramp_to"), rate)
        case {"hold_s": seconds} if len(entry) == 1:
            return Hold(arguments.number(seconds, "hold_s"))
    raise InputError("must have ramp_to and perhaps rate, or hold_s alone")
