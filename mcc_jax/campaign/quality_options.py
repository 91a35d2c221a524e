"""What counts as a fault of the tester."""

from __future__ import annotations

from dataclasses import dataclass, field

from .._format import described
from .saturation import SaturationOptions


@dataclass(frozen=True)
class QualityOptions:
    """What counts as a fault of the tester. Each number is chosen so that no honest record can reach it.

    Attributes:
        spike_noise: a reading is a spike from so many standard deviations of the noise on. Of 1e6 normal readings the
            farthest lies at 5; the rest is for noise that is not normal.
        spike_steps: and from so many times the step between neighbouring readings on: a turning point of a ramp lies
            within 3 steps of the median of the seven readings around it, and every half of a cycle has some readings.
        spike_read_out: and from so many of the smallest steps of the read-out on.
        spike_range: and from this share of the channel's range (5 to 95 %) on.
        stuck_readings: readings that repeat, at least; also three times as many as the channel repeats elsewhere, which
            is what a coarse read-out does.
        stuck_catch_up: share of the ramp's progress in that time which the jump behind them makes up for, at least.
        begins_at: a record begins at its largest force if its first readings reach this share of it.
        stuck_jump: and this jump is so many times larger than any step near it, at least: a coarse read-out jumps by
            one step at a time.
        loss_of_force: share of the largest force that a breaking particle loses, at least. Settling and rotation of
            ceramic pebbles lose up to a tenth at once.
        loss_readings: within so many readings, at most.
        loss_pace: and so many times faster than the force changes elsewhere, at least.
        loss_from: and from this share of the largest force on: below it, the platens bounce on asperities.
        loss_noise: and so many standard deviations of the noise, at least.
        goes_on: force that falls is no unloading if the platens go on closing at this share of their speed, at least:
            in an unloading they part, and creep in its first readings is slower than the loading before it.
        air_readings: readings in the air, at least: fewer do not give the zero's error.
        air_said: an offset is told from so many standard deviations on,
        air_share: and from this share of the largest force on: below it no answer moves by a tenth of its error.
        drift_said: a drift in the air is told from so many standard deviations of its slope on, and from `air_share`.
        drift_slower: a straight rise in front of the loading is a drift if its slope is this share of the loading's, at
            most, as is any straight fall; the first contact of asperities is not straight.
        drift_like: up to this share it may be one, and is told.
        other_stiffness: if force over displacement is not another one there, by this factor, only the tester's speed
            was.
        start_share: of the largest force, in front of which such a rise is looked for: farther on loading itself bends.
            A preload is no larger.
        zero_mN: zero of force of records that begin in contact, and its error [mN]; their file's own if None.
        saturation: when a channel counts as saturated.
    """

    spike_noise: float = 15.0
    spike_steps: float = 5.0
    spike_read_out: float = 2.5
    spike_range: float = 0.02
    stuck_readings: int = 6
    stuck_catch_up: float = 0.5
    stuck_jump: float = 2.5
    begins_at: float = 0.95
    loss_of_force: float = 0.25
    loss_readings: int = 3
    loss_pace: float = 5.0
    loss_from: float = 0.05
    loss_noise: float = 10.0
    goes_on: float = 0.5
    air_readings: int = 5
    air_said: float = 3.0
    air_share: float = 1e-3
    drift_said: float = 5.0
    drift_slower: float = 0.1
    drift_like: float = 0.7
    other_stiffness: float = 1.5
    start_share: float = 0.1
    zero_mN: tuple[float, float] | None = None
    saturation: SaturationOptions = field(default_factory=SaturationOptions)

    __repr__ = described()
