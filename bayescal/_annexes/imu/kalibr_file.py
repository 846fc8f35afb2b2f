"""The noise of an inertial unit as a file for Kalibr (imu.yaml), from channels at rest.

Kalibr's noise model has two terms, in continuous time: a noise density (N of IEEE 952) and the random walk of the bias
(K). Source: https://github.com/ethz-asl/kalibr/wiki/IMU-Noise-Model.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.vector_parameters import si_of

KINDS = {"accelerometer": "m/s^2", "gyroscope": "rad/s"}
# terms that correlate neighbours only
SHORT_TERMS = {"quantisation": "quantisation", "averaging": "what the sensor has averaged"}
TOPIC = re.compile(r"[~/]?[A-Za-z][A-Za-z0-9_/]*")  # http://wiki.ros.org/Names
STEP_TOLERANCE = 0.05  # relative difference of the sampling steps of one unit's channels


def kalibr_yaml(
    channels: Mapping[str, bc.SensorNoise], topic: str = "/imu0", quantile: float | None = None
) -> str:
    """Format an imu.yaml from the noise of channels; of several axes the noisiest counts.

    Args:
        channels: noise of each channel, by its name, of an accelerometer, a gyroscope, or both.
        topic: of the messages, `rostopic`.
        quantile: of the posterior, which every number is.

    Raises:
        InputError: a channel is neither, or their rates differ, the quantile is no probability, or the topic no name.
    """
    quantile = ws.FILTER_QUANTILE if quantile is None else quantile
    if not 0 < quantile < 1:
        raise bc.InputError(f"the quantile {quantile:g} must be between 0 and 1, such as 0.95")
    if not TOPIC.fullmatch(topic):
        raise bc.InputError(
            f"the topic {topic!r} is no name of ROS: letters, digits, _ and /, such as /imu0"
        )
    steps = {name: noise.step for name, noise in channels.items()}
    if max(steps.values()) > (1 + STEP_TOLERANCE) * min(steps.values()):
        raise bc.InputError(f"channels of one unit have one rate, not steps of {steps} s")
    kinds = {name: _kind(name, noise.unit) for name, noise in channels.items()}
    lines = [
        "# Noise of an inertial measurement unit at rest, for Kalibr. Continuous time, SI units.",
        f"# Every number is the {quantile:.0%} quantile of its posterior, of the noisiest axis.",
    ]
    for name, noise in channels.items():
        lines.append(f"# {ws.c_comment(name)}: {noise.law}. {_left_out(noise)}")
        doubts = (ws.c_comment(str(claim)) for claim in noise.claims if claim.severity != "note")
        lines += [f"#   Not to be used as they are: {doubt}" for doubt in doubts]
        for n in (figure for figure in noise.figures if figure.symbol == "N"):
            middle, low, high = (f"{value:.4e}" for value in n.si)
            density = f"{middle} {n.si_unit} ({low} to {high})"
            lines.append(f"#   N: {'not determined, below an upper bound' if n.bound else density}")
    for kind, unit in KINDS.items():
        lines.append(f"# {kind}, {unit}")
        if not (group := [noise for name, noise in channels.items() if kinds[name] == kind]):
            lines.append(f"#   no {kind} was given: its two numbers are missing")
            continue
        pairs = [[v * si_of(c.unit)[0] for v in c.for_filter(quantile)] for c in group]
        density, walk = (max(column) for column in zip(*pairs, strict=True))
        lines.append(f"{kind}_noise_density: {density:.4e}")
        lines.append(f"{kind}_random_walk: {walk:.4e}")
    rate = 1 / min(steps.values())
    return "\n".join([*lines, f"rostopic: {topic}", f"update_rate: {rate:.6g}", ""])


def _left_out(noise: bc.SensorNoise) -> str:
    horizon, lasting = f"{noise.horizon:.3g} s", {*noise.terms} - SHORT_TERMS.keys()
    short = [w for t, w in SHORT_TERMS.items() if t in noise.terms]
    brief = "".join(f"White noise stands for {w} too. " for w in short)
    if not lasting:
        term = f"No random walk is seen in averages up to {horizon}: the one given is a bound."
        return brief + term
    if lasting == {"walk"}:
        return brief.strip() or "Nothing is left out."
    return (
        f"{brief}A random walk takes the place of the correlated terms: with the density it reaches 95 % of the "
        f"law's Allan deviation up to {horizon}; beyond, it grows where this law does not."
    )


def _kind(name: str, unit: str) -> str:
    for kind, target in KINDS.items():
        if si_of(unit or "1")[1] == target:
            return kind
    raise bc.InputError(
        f"the channel {name!r} in {unit or 'no unit'} is neither a gyroscope's nor an accelerometer's: an imu.yaml has "
        f"no place for it. Say its unit: {ws.option('--unit', f'{name}=UNIT')}"
    )
