"""What an export says of itself: where it comes from, and what to know."""

from __future__ import annotations

from dataclasses import dataclass

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.description import identity, sources_of
from bayescal._calibration.mixture import inclusion
from bayescal._core.version import __version__
from bayescal._use.operating_equation import OperatingEquation

NOT_RELIABLE = "RESULT NOT RELIABLE: "


@dataclass(frozen=True)
class Provenance:
    """Where an export comes from and what may be done with it.

    Attributes:
        instrument: its name; title: one line.
        stimulus, unit: what is compensated for; output_unit: of the reading.
        effects: (name, equation) of those that act.
        reference: constants of the bases, such as T0.
        sources: (file, sha256) of the readings.
        raw: how a raw output becomes the reading: unit, gain, offset; None if it is the reading.
        notes: what to know, each a sentence.
        made_by: program and version.
        calibration: its identity; empty in exports that do not state one.
    """

    instrument: str
    title: str
    stimulus: str
    unit: str
    output_unit: str
    effects: tuple[tuple[str, str], ...]
    reference: dict[str, float]
    sources: tuple[tuple[str, str], ...]
    raw: tuple[str, float, float] | None
    notes: tuple[str, ...]
    made_by: str
    calibration: str = ""

    @property
    def why_not(self) -> str:
        """Why the result is not to be used, in words; empty where it may be."""
        told = (n for n in self.notes if n.startswith(NOT_RELIABLE))
        return next(told, "").removeprefix(NOT_RELIABLE)

    @property
    def notes_on_use(self) -> tuple[str, ...]:
        """The notes but what stands against using it."""
        return tuple(n for n in self.notes if not n.startswith(NOT_RELIABLE))


def provenance_of(
    calibration: Calibration,
    equation: OperatingEquation,
    stimulus_range: tuple[float, float] | None,
) -> Provenance:
    """What an export says of itself."""
    instrument, use = calibration.model.instrument, equation.use
    acting = dict.fromkeys(b.effect for b in equation.blocks)
    scale = calibration.readings.scale or instrument.nominal_scale
    reference = {
        k: float(v)
        for k, v in calibration.reference.items()
        if not isinstance(v, dict) and not k.endswith(("_low", "_high"))
    }
    why_not = calibration.verdict.why_not
    unreliable = (f"{NOT_RELIABLE}{why_not}",) if why_not else ()
    return Provenance(
        instrument=instrument.name,
        title=instrument.title,
        stimulus=use.stimulus,
        unit=use.unit,
        output_unit=calibration.unit,
        effects=tuple((e.name, e.equation) for e in acting),
        reference=reference,
        sources=tuple((s.file, s.sha256) for s in sources_of(calibration.readings)),
        raw=(scale.unit, scale.gain, scale.offset) if scale else None,
        notes=(*notes_on_use(calibration, equation, stimulus_range), *unreliable),
        made_by=f"bayescal {__version__}",
        calibration=identity(calibration),
    )


def averaged_over(calibration: Calibration) -> list[str]:
    """That the values are an average over structures, and how probable each effect is; nothing where they are none."""
    shares = {name: share for name, share in inclusion(calibration).items() if share < 1}
    if not shares:
        return []
    said = ", ".join(f"{name} {share:.2f}" for name, share in shares.items())
    return [
        f"Averaged over structures with their probabilities ({said}): means and uncertainties hold what is not known "
        "of the structure."
    ]


def bias_only(stimulus: str) -> str:
    """What is said where no unknown acts on how the output follows the stimulus."""
    return (
        f"Only the bias was calibrated: the scale factor for {stimulus} is taken as known, and its error is in no "
        "uncertainty."
    )


def notes_on_use(
    calibration: Calibration,
    equation: OperatingEquation,
    stimulus_range: tuple[float, float] | None,
) -> tuple[str, ...]:
    """What to know before a reading is compensated, each a sentence."""
    notes = averaged_over(calibration)
    new = [u.name for u in equation.unknowns() if u.kind == "new"]
    if new:
        notes.append(
            f"Taken as new in use, with the between-group standard deviation of the calibration: {', '.join(new)}."
        )
    for lag in equation.lags:
        if lag.shape:
            notes.append(
                f"{lag.name} is the lag for {lag.shape} = {lag.tau:.6g} s; the uncertainty of this time is "
                f"counted through {lag.slope}."
            )
    stimulus = equation.use.stimulus
    if not equation.slope_calibrated(calibration):
        notes.append(bias_only(stimulus))
    elif stimulus_range is None:
        notes.append(f"The range of {stimulus} in the calibration is not stated.")
    return tuple(notes)
