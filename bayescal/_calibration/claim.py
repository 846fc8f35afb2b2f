"""A claim: something that the program says of readings or of a result, as data; and the words of all claims by code.

This is the one place where words are made, and changed without touching mathematics. A template is filled with what its
claim holds. A number without a format has three significant digits; `:unit` is a unit as people read it; names in a
tuple are joined by "and", or by commas (`:list`); `of[0]` is the first it is of.
"""

from __future__ import annotations

import re
import string
from typing import Any, NamedTuple, Self

from bayescal._core.flag import Flag
from bayescal._core.formatting import number
from bayescal._data.unit_conversion import unit_label

# Code (severity), what it says, and behind → what to do; of several cures the claim says which, by the [name];
# "as" another claim's.
# A "stop" and a "doubt" shut the gate, a "note" does not.
CATALOGUE = """\
kept (doubt)
    {words}

# What a fit may not be (judgement.py)
prior.contradicted (stop)
    {of[0]} stands {away:.0f} times its plausible size from its prior's mean ({where} against {mean} ± {size}
    {unit:unit}; its log probability falls by {fall:.0f}):
  → [zero and scale] check the nominal zero (--nominal-zero '1.21 V') and scale (--nominal-scale '250 V/g'), give it a
    wider prior, or accept it (calibrate --accept-conflict {of[0]}).
  → [scale] check the nominal scale (--nominal-scale '250 V/g'), give it a wider prior, or accept it (calibrate
    --accept-conflict {of[0]}).
  → [units] check the units of the columns and the nominal scale (--nominal-scale '250 V/g'), give it a wider prior, or
    accept it (calibrate --accept-conflict {of[0]}).
prior.widened (stop)
    {of[0]} is known worse than before the readings (contraction {contraction:.1f}): the fit did not converge.
size.beyond_output (stop)
    {of[0]} is larger than the output's whole range ({mean} against {reach} {unit:unit}): the readings lie far from what
    the model can be.
  → Check the nominal zero and scale.
curve.beyond_known (stop)
    {of[0]} changes the output by {here} {unit:unit} rms, where all known effects at plausible sizes would change it by
    {known} {unit:unit}:
  → check the sign, the unit and the nominal scale (--nominal-scale '250 V/g') of the output and of the inputs.
group.too_different (doubt)
    {member} stands {away:.0f} times its plausible size from the mean of such ({where} against {mean} ± {size}
    {unit:unit}):
  → check the sign, the units and the device of each {group}, give it a wider prior, or accept it (calibrate
    --accept-conflict {of[0]}).
group.follows_column (doubt)
    The coefficient {term} is not measured: {of[0]} follows {along} from one {group} to the next (correlation {r:.2f}
    over {members}, p = {p:.1g}), and within each the readings deny it.
  → Look at the column {along}: late, held, smoothed or noisy? Or accept it (calibrate --accept-conflict {of[0]}).
mode.indefinite (doubt)
    The curvature at the mode is not positive definite: the fit ended on a ridge or a saddle. Log evidence and standard
    uncertainties are not reliable.
  → Take an effect out that these readings do not determine.
mode.two (doubt)
    Two modes explain the readings nearly as well (log Bayes factor {behind:.1f}): {values:list}. The fit describes one
    of them.
effect.off_scale (note)
    {of[0]} contributes at most {contribution} {unit:unit} at its plausible size, where the noise is {noise}
    {unit:unit}:
  → check the units of the output and of the columns; of an effect of your own also its prior, in {own}, and its basis,
    which gets columns in the units that the instrument declares and others in base units (45 % is 0.45).

# What a fit's own readings say against it (judgement.py)
output.rounded (stop)
    The output is rounded in steps of {grid:.3g} {unit:unit}, which is more than its noise: nothing finer than a step
    can be known, and standard uncertainties are too small.
  → Record it with more digits.
group.surprising (doubt)
    {group} {member} is not like the others: predicted from these, its errors are {times:.1f} times what they should be
    ({scheme}). Its thermometer or a setting was different, or the sensor changed:
  → look at its columns, or leave it out.
column.odd (doubt)
    Column {of[0]!r} {said}: what depends on it is not measured.
fit.not_converged (stop)
    The fit did not converge: {reasons}
fixed.wrong (stop)
    The fixed coefficients leave residuals of {rms:.3g} {unit} rms, {times:.1f} times the noise of the same model with
    free coefficients.
evidence.not_finite (doubt)
    The log evidence is not finite: the readings have too few digits, or a prior is improper.
noise.correlated (doubt)
    Noise model inadequate: neighbouring residuals are correlated ({coefficient:.2f}, z = {z:.1f}), so the probabilities
    of missing effects are too confident. Either the noise is correlated in time or something is missing that no
    candidate describes.
noise.describes (doubt)
    The noise ({words}) stands for something that has no name here: its Allan deviation reaches {size:.2g} {unit:unit}
    within a run, {times:.0f} times the noise of a single reading.
  → Look for what moves the output so, and add it (--effect, --add); a repeat of the test tells a cause from noise.
noise.scatter (doubt)
    Noise model inadequate: the scatter changes with {of}, so standard uncertainties hold for no part of the record.
  → Give the readings their own uncertainties (column output_uncertainty).
noise.one_sided (doubt)
    Noise model inadequate: readings far from the model stand on one side (p = {p:.1g}): outliers that draw it there.
  → Find what makes them, and leave them out.
noise.tails (doubt)
    Noise model inadequate: readings do not scatter about the model as normal noise does (leave-one-out probabilities
    uniform: p = {p:.1g}{outside}).
  → Look at the readings; a model with noise bc.StudentT() bears outliers on both sides.
readings.too_few (doubt)
    {count} readings are too few for {free} unknowns: the noise cannot be told, and uncertainties hang on the priors.
residuals.depend (doubt)
    The residuals still depend on {of} (log Bayes factor {factor:.0f}):
  → [search] something is missing from the model. Look for it: bayescal discover, or calibrate.
  → [lead] {named} may be what is missing. Add it (--add {lead}), or take the readings of the next experiment.
  → [nothing] something is missing that no candidate describes, or readings of two devices or conditions are mixed.
runs.apart (doubt)
    Runs stand {apart:.3g} {unit:unit} apart ({of[0]} steps where none goes on): they are of two devices or conditions,
    or the sensor was restarted: a new run cannot be predicted.
runs.unlike (doubt)
    Predicted from the others, runs are off by much the same all along: {apart:.3g} {unit:unit} between runs,
    {within:.3g} within them, and the model has no name for it. They are of two devices or conditions, or the sensor
    differs from start to start: a new run cannot be predicted.
  → Calibrate each device or condition by itself. Of one sensor, take more runs, or add a deviation from run to run.

# What a search says against its last model (gate.py)
value.freed (doubt)
    {of:list}: the readings are explained with a value other than the stated one, and by no missing effect alone.
term.replaced (doubt)
    The coefficient {of[0]} is not measured, whatever its contraction in the model shown: {column} no longer explains
    the output, {by} stands for it, and these readings cannot tell which it is ({of[0]} is {kept:.2g} times what it was
    without {by}, {moved:.0f} standard uncertainties away).
  → [one run] Look at the column {column}: late, held, smoothed? Or does a body lag for longer than the run? {another}
  → [runs] Look at the column {column}: late, held, smoothed, another's in one run? Or does a body lag for longer than a
    run? {another}
term.replaceable (doubt)
    The coefficient {of[0]} is not measured, whatever its contraction in the model shown: {by} can stand for it, as the
    profiles are, and these readings cannot tell which it is ({of[0]} is {kept:.2g} times what it was without {by},
    {moved:.0f} standard uncertainties away).
  → as term.replaced
equivalent.undecided (doubt)
    These readings cannot tell {of[0]} from {beside}: they belong in the model together, each as uncertain as its prior
    leaves it, and which of them acts in use is not decided.
  → [test] Of the instrument's experiments {experiment!r} would tell best ({nats:.1f} nats at plausible sizes).
  → [none] None of the instrument's experiments would tell: take another set-up, or state the size of one of them.
complete.undecided (doubt)
    The model is complete with probability {complete:.2g} only, and the readings do not tell what is missing; the most
    probable are {named:list}.
step.raises_error (doubt)
    Step {step!r} raises the error as fitted, {then:.3g} → {now:.3g} {unit:unit}: do not use it.
step.predicts_worse (doubt)
    The last model predicts {what} worse than step {step!r}, {then:.3g} → {now:.3g} {unit:unit}: what was changed since
    holds for these readings alone.
holdout.contradicts (doubt)
    The hold-out data contradict the last model: its error there, {error} {unit:unit}, would be {other} with other
    coefficients{before} (p = {p:.2g}). They are of another device or condition, or the model is wrong.
holdout.scatters (doubt)
    The hold-out data scatter {scatter:.1f} times as much as the last model expects. They are of another device or
    condition, or the model is wrong.

# What does not stand against it, and is to be known
direction.none_exactly (note)
    {of[0]}: these readings say nothing of it; its interval is the prior's (exactly)
direction.other_exactly (note)
    {combination}: this combination is not identifiable; only other combinations of these coefficients are measured,
    this one keeps the prior's width (exactly)
direction.none (note)
    {of[0]}: these readings say nothing of it; its interval is the prior's
direction.other (note)
    {of}: only another combination of them is measured; in this model, this one keeps the prior's width
direction.members (note)
    {count} combination(s) of the single coefficients of {of:list}: these readings do not tell them apart; they keep the
    width of their prior
direction.confounded (note)
    {of} apart from {column}: these readings tell {told:.1g} of its squares from the model. Standard uncertainties hold
    what it may have done in their place; the sum of both is measured.
  → Vary {vary} otherwise in another run, or leave it out if it is no cause (--ignore {vary})
column.rounded (note)
    {of} apart from half a step of {column!r}, {grid:.3g}: whether its readings were rounded or cut off is not told by
    the file, and all of them may be off alike. Standard uncertainties hold that (step/√12).
equivalent.latent (note)
    These readings cannot tell {of[0]} from {beside}: they belong in the model together, each as uncertain as its prior
    leaves it.
  → as equivalent.undecided
equivalent.candidates (note)
    These readings cannot tell {of[0]} from {beside}.
term.confounded (note)
    {of[0]} and {by} are confounded in these readings, which tell {left:.1%} of it apart: their standard uncertainties
    hold both.
  → Vary {column} otherwise in another run.
profile.one (note)
    All runs have one profile of {column}: what repeats with the time within a run ({of}) is told from the temperature
    by its form alone. {another}
thermometer.or_sensor (note)
    Not decidable from these readings: whether the sensor has {of}, or the thermometer ({columns:list}) or the output is
    late, slow or drifting. Predictions hold with this thermometer and this logger;
  → compare the thermometer once with one at the sensor.
level.which (note)
    Not decidable from these readings: which of two levels, {apart} {unit:unit} apart, is that in use: the output steps
    at {at} s ({of[0]}), and the coefficients are of their mean.
  → Look at what happened there; readings of another state belong in a file of their own.
input.one_order (note)
    Not decidable from these readings: whether {of[0]} is of the sensor, or the output is late or smoothed: {column}
    goes through its values in one order.
  → Take them in another order in one run.

# What was done to a record at rest, and what it cannot tell (sensor_noise.py)
noise.held (note)
    The output is held: a value stands for {times} readings on average, and one reading of each is taken.
noise.means (note)
    Below {time} s neighbouring readings are correlated, by a low-pass, a mean or an interpolation: all is read from
    means of {count} readings, along which the Allan deviation falls with slope −½.
noise.no_level (note)
    The Allan deviation nowhere falls with slope −½ over two octaves: {name} is not seen.
  → Record for longer, without a low-pass.
noise.temperature (note)
    A polynomial of degree {degree} over {of[0]} was taken out beside the noise.
noise.lost (note)
    {share:.2g} % of the readings were lost: they are drawn from the noise law, given the others.
noise.ended (note)
    The search for the noise law was ended early ({why}): sums that were not fitted may be more probable.
noise.outside (doubt)
    The Allan deviation lies outside the interval that holds 95 % of such records at {count} of {times} averaging times
    ({taus:list} s): the noise law does not describe this record.
  → Look at its spectrum (a vibration, an event, a setting that changed), or give a part of it.
"""


class Words(NamedTuple):
    """What a code means for the result, what it says, and what to do: by name, "" where there is one cure."""

    severity: str
    says: str
    cures: dict[str, str]


ENTRY = re.compile(r"^(\S+) \((\w+)\)\n((?:    .*\n)+)((?:  → .*\n(?:    .*\n)*)*)", re.MULTILINE)
CURE = re.compile(r"  → (?:\[(.+?)\] )?(.*\n(?:    .*\n)*)")


def _read(catalogue: str) -> dict[str, Words]:
    """Code → words, of the text above."""
    found: dict[str, Words] = {}
    for code, severity, says, told in ENTRY.findall(catalogue):
        cures = {name: " ".join(text.split()) for name, text in CURE.findall(told)}
        if (other := cures.get("", "")).startswith("as "):
            cures = found[other.removeprefix("as ")].cures
        found[code] = Words(severity, " ".join(says.split()), cures)
    return found


WORDS = _read(CATALOGUE)


class _Filled(string.Formatter):
    """`str.format` with what the templates here are filled with."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec == "unit":
            return unit_label(value)
        if isinstance(value, tuple):
            return (", " if format_spec == "list" else " and ").join(map(str, value))
        if isinstance(value, float) and not format_spec:
            return number(value)
        return super().format_field(value, format_spec)


class Claim(Flag):
    """What is said and what to do, as text that knows its code, names and numbers: code asks these, never the words.

    Attributes:
        code: a key of `WORDS`.
        of: names of the effects, coefficients, columns or groups that it is of, the most important first.
        numbers: what its words hold, by name: numbers, names (several in a tuple) and units.
    """

    numbers: dict[str, Any]

    def __new__(cls, code: str, *of: str, **numbers: Any) -> Self:
        cure = WORDS[code].cures.get(numbers.get("cure", ""), "")
        template = f"{WORDS[code].says} {cure}".rstrip()
        said = _Filled().vformat(template, (), {"of": of, **numbers})
        made = super().__new__(cls, said, code, *of)
        made.numbers = numbers
        return made

    def __getnewargs_ex__(self) -> tuple[tuple[str, ...], dict[str, Any]]:
        return (self.code, *self.of), self.numbers

    @property
    def severity(self) -> str:
        """What it means for the result: "stop" and "doubt" shut the gate, a "note" does not."""
        return WORDS[self.code].severity

    def data(self) -> dict[str, Any]:
        """Return what result.json has of it."""
        told = {"code": self.code, "of": list(self.of), "severity": self.severity}
        return {**told, "in_words": str(self)}


def as_claim(words: str) -> Claim:
    """Return a claim as it is, and what a saved calibration says against itself as one of which only words are left."""
    return words if isinstance(words, Claim) else Claim("kept", words=words)
