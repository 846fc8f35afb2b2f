"""Numbers that decide what is refused in a record, said of it or set aside before a fit: unit, reason, where from."""

from __future__ import annotations

from dataclasses import dataclass

from bayescal._core.settings_in_force import OutcomeSettings, in_force


@dataclass(frozen=True)
class RecordSettings(OutcomeSettings):
    """What a record may not be, and what of it is no reading of the sensor.

    "Good records" are the campaigns that the six instruments simulate, as they are, rounded as displays do, and noisy
    (tests/readings/test_thermometers.py); "spoilt" ones are those of docs/gauntlet.md and docs/thermometers.md.

    Attributes:
        pause: usual steps between readings, beyond which the next one is no neighbour; a logger that loses four
            readings in a row has not paused.
        interleaved: changes from one record to the other, a reading, beyond which two lie in one time and neither goes
            on with the other.
        silence: windows of a rate (a minute each) without a reading, after which a rate is not known: the change over
            hours, such as a soak before a tumble, says nothing of the rate now.
        temperature_span: °C, below which a record has one temperature; what a good chamber holds.
        plateau: standard deviations within runs, that the temperatures of runs are apart at the least where each has
            one of its own: a slope within runs then has a hundredth of the information.
        clipped: readings at the very end of an output's range, below which that may be chance.
        clipped_share: of all readings, likewise, of a long record.
        clipped_gap: of the range, between an end and the next level, beyond which the end is a set-up of its own, such
            as one position.
        clipped_excess: times the readings at the next level, below which an end is that of a rounded output.
        stuck: readings in a row without a change, below which that may be chance.
        stuck_excess: times the next longest stretch.
        stuck_share: of a record, from which a stretch is no plateau of a rounded thermometer.
        repeated: of the other readings repeat the one before, above which all are rounded, or set.
        few_changes: changes of a column, below which nothing is usual in it.
        leap: of a thermometer's range: less is no leap.
        leap_noise: robust standard deviations of a thermometer's own leaps there and back, beyond which one is no
            noise: of normal noise not one in 10¹⁴ readings.
        leap_excess: times the change that nine tenths of a thermometer's changes stay below: a body does not go five
            times as fast for one reading.
        leap_share: of all readings; more leaps are a thermometer's noise, or its way.
        end_excess: times every other change of a stretch, above which its first or last reading stands apart.
        held_step: steps of a rounded column, above which a change is a leap: noise toggles by one or two.
        held_times: such leaps, below which that may be chance; good records have none.
        held_share: likewise, of a stretch's changes.
        saturated: readings in a row at a thermometer's extreme, below which that may be chance.
        same_times: of two runs' readings that have the same times, from which the runs can be compared.
        repeats: of a thermometer's range, to which it repeats from run to run where a profile does.
        together: correlation of two thermometers in a run, from which they are on one body: that of a lag of an eighth
            of a wave (cos 45°).
        as_wide: times the range of the other, beyond which one is in the laboratory and one in the chamber.
        unlike: times what its sibling repeats to, beyond which a thermometer was different in a run.
        unlike_least: °C: what a thermometer good to 0.5 °C (uniform) differs by from one time to another.
        spike: robust standard deviations of a reading's distance from the line through its neighbours; of a million
            normal readings none.
        spike_fewest: readings of a stretch, below which its scatter is not known well enough to call one a spike.
        spike_share: of all readings; where more stand out, the noise may be heavy-tailed, and its tail is asked.
        spike_most: of all readings; more are no spikes, whatever the tail.
        tail: robust standard deviations, from which a distance is in the tail.
        usual_tail: exponent of a tail before it is seen, and how many distances that counts as: Student's t with two
            degrees of freedom, the heaviest for which laws of noise are asked.
        tail_chance: probability that a tail without spikes has a gap like that before one.
        rounded: of all readings, that distinct values are at most where values occur again by rounding.
        off_grid: of a step, by which values on a grid may be off it; numbers are written with two digits more.
        as_good_as_noise: steps, from which noise makes rounding as good as noise: noise of 0.3 steps leaves a staircase
            of 0.05 (B. Widrow and I. Kollár, Quantization Noise, 2008), with the rounding's own 1/√12.
        same_tick: of the readings that have the time of the one before, from which a clock is too coarse or has too few
            digits: most changes are lost.
        counted_runs: runs of one reading each, below which that may be the plan of a test.
        not_new: of the hold-out data that occur among the readings; more is no chance where each is one of its kind.
        one_of_its_kind: of the readings that differ in their numbers from all others, from which that can be said.
        set_jump: usual changes of a column, beyond which a change is a step between two settings, over which no mean
            is taken.
        set_jumps: of the readings that may be such steps, which leave ten to a mean at the least.
        placeholder: ranges of the others, beyond which a −999 or 9999 is no reading.
        levels: different values of a thermometer, of fewer of which each change is as large as its range.
        most: share of a thermometer's changes that are usual ones: a rounded corner of a profile is among the rest.
        direction: share of the readings during which a temperature must rise, and fall, for a hysteresis to show.
        stirred: °C, range of a temperature at rest, below which it is taken as constant: two steps of a thermometer
            that is read to 0.1 °C.
        second_correlated: readings of the longest run, below which a second correlated noise is not told from the
            first.
        even: of the usual step, by which others may differ where steps are to be even: time stamps jitter.
        allan_readings: of the longest run, below which no slope of an Allan deviation is told from another.
        allan_slope: from the slope of one kind of noise on log axes to where that of the next begins: half of ½.
        allan_coverage: standard uncertainties, as everywhere that an interval of 95 % is meant.
        allan_straight: p-value of a line through part of an Allan deviation, below which it is none.
        still_block: s: of a unit in the hand or on a bench, short against a move, long against a filter of 20 Hz.
        still_quiet: quantile of the blocks' scatter, that is taken as at rest.
        still_scatter: times that, up to which a block is still: means of blocks of filtered noise differ by 4 once in
            10⁴.
        still_shortest: s, of a pose: eight blocks, whose means say how well theirs is known.
        still_samples: in a block, from which on their scatter says something.
        resolved: unit, least and largest range of an output that any sensor resolves and measures. Least: a
            superconducting gravimeter resolves 1e-12 m/s², a large ring laser 1e-13 rad/s, an interferometer on a lever
            1e-12 rad. Most: gauges of impacts end at 2e6 m/s², rotors of any kind at 1e5 rad/s, and an angle beyond
            1e4 rad has been counted in turns.
    """

    pause: float = 5.0
    interleaved: float = 0.2
    silence: float = 10.0
    temperature_span: float = 0.1
    plateau: float = 10.0
    clipped: int = 5
    clipped_share: float = 0.01
    clipped_gap: float = 0.1
    clipped_excess: float = 3.0
    stuck: int = 8
    stuck_excess: float = 4.0
    stuck_share: float = 0.5
    repeated: float = 0.1
    few_changes: int = 20
    leap: float = 0.02
    leap_noise: float = 8.0
    leap_excess: float = 5.0
    leap_share: float = 0.05
    end_excess: float = 3.0
    held_step: float = 3.0
    held_times: int = 6
    held_share: float = 0.05
    saturated: int = 5
    same_times: float = 0.5
    repeats: float = 0.02
    together: float = 0.7
    as_wide: float = 3.0
    unlike: float = 5.0
    unlike_least: float = 0.3
    spike: float = 8.0
    spike_fewest: int = 50
    spike_share: float = 0.005
    spike_most: float = 0.05
    tail: float = 4.0
    usual_tail: tuple[float, float] = (2.0, 5.0)
    tail_chance: float = 0.01
    rounded: float = 0.5
    off_grid: float = 0.01
    as_good_as_noise: float = 0.42
    same_tick: float = 0.5
    counted_runs: int = 8
    not_new: float = 0.1
    one_of_its_kind: float = 0.5
    set_jump: float = 10.0
    set_jumps: float = 0.1
    placeholder: float = 3.0
    levels: int = 3
    most: float = 0.9
    direction: float = 0.02
    stirred: float = 0.2
    second_correlated: int = 150
    even: float = 0.05
    allan_readings: int = 30
    allan_slope: float = 0.25
    allan_coverage: float = 2.0
    allan_straight: float = 1e-3
    still_block: float = 0.25
    still_quiet: float = 0.1
    still_scatter: float = 6.0
    still_shortest: float = 2.0
    still_samples: int = 4
    resolved: tuple[tuple[str, float, float], ...] = (
        ("m/s^2", 1e-12, 1e7),
        ("rad/s", 1e-13, 1e5),
        ("rad", 1e-12, 1e4),
    )


def recording() -> RecordSettings:
    """The settings of records that hold here."""
    return in_force(RecordSettings)
