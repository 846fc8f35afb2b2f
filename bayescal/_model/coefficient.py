"""A named unknown: a coefficient (the model is linear in it) or a shape (a few are not)."""

from __future__ import annotations

import math
from typing import Literal

import equinox as eqx

from bayescal._core.errors import ModelError
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal, LogNormal, Normal

Group = Literal["reading", "cell", "run", "axis", "device"]

OPEN = (0.0, math.inf)  # low and high of a shape whose plausible range the readings say


class Coefficient(eqx.Module):
    """One unknown that a slot is linear in.

    Attributes:
        unit: the unit it is reported in and its prior is stated in, such as "deg/s/degC" or "ppm/degC".
        prior: Gaussian or flat. For a coefficient with a learned spread only its mean counts.
        part: its name within the effect, such as "parallel,M2,cos"; empty if the effect has just one.
        slot: the slot it feeds, where that is not the effect's own.
        per: None for one value; a group ("run", "cell", "device", "axis", "reading") for one value each.
        spread: prior of the standard deviation between the group's members, which is then learned.
            None leaves it at the prior's own sd.
    """

    unit: str = eqx.field(static=True)
    prior: Normal | Flat = eqx.field(default_factory=Normal)
    part: str = eqx.field(static=True, default="")
    slot: str | None = eqx.field(static=True, default=None)
    per: Group | None = eqx.field(static=True, default=None)
    spread: HalfNormal | HalfCauchy | Flat | None = None

    def __check_init__(self) -> None:
        if self.spread is not None and self.per is None:
            raise ValueError("a learned spread needs a group to be learned over: give `per`")
        if self.per == "reading" and self.spread is not None:
            raise ValueError("a spread over single readings is noise: give it to the noise law")

    @property
    def flat(self) -> bool:
        return isinstance(self.prior, Flat) and self.spread is None

    @property
    def mean(self) -> float:
        return self.prior.mean if isinstance(self.prior, Normal) else 0.0

    @property
    def size(self) -> float:
        """The plausible size, in `unit`: the prior's sd, or the spread prior's scale."""
        if self.spread is not None:
            return self.spread.scale
        return self.prior.sd if isinstance(self.prior, Normal) else self.prior.scale


class Shape(eqx.Module):
    """One unknown that the model is not linear in: a lag time, a period, a ratio of frequencies.

    The prior puts 95 % between `low` and `high`; its coordinate is standard normal.

    Attributes:
        name: keyword under which the effect's basis receives it, such as "tau".
        unit: the unit in which the basis takes it and in which it is reported.
        low, high: plausible range, in `unit`; `OPEN` for one to be taken from the readings.
        scale: "log" for a log-normal prior (positive quantities), "linear" for a normal one.
        ragged: whether the evidence has many maxima over it, as over a period; the search begins at more points.
    """

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    low: float = eqx.field(static=True)
    high: float = eqx.field(static=True)
    scale: Literal["log", "linear"] = eqx.field(static=True, default="log")
    ragged: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        positive = self.low > 0 or self.open
        if not self.low < self.high or (self.scale == "log" and not positive):
            raise ValueError(f"shape {self.name!r} needs low < high, and positive if logarithmic")

    @property
    def open(self) -> bool:
        """Whether its plausible range is to be taken from the readings."""
        return (self.low, self.high) == OPEN

    @property
    def prior(self) -> LogNormal | Normal:
        """Prior of the value.

        Raises:
            ModelError: its range is open still.
        """
        if self.open:
            raise ModelError(
                f"the plausible range of {self.name!r} is taken from readings, and there are none yet: fit the model, "
                "or give low and high"
            )
        if self.scale == "log":
            sd = math.log(self.high / self.low) / (2 * 1.959963984540054)
            return LogNormal(math.sqrt(self.low * self.high), sd)
        return Normal((self.low + self.high) / 2, (self.high - self.low) / (2 * 1.959963984540054))
