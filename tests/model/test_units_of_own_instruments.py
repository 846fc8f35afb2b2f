"""An instrument of one's own is right in whatever units it is declared, or refused with the units that do not agree."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro

ARCSEC = math.pi / 648000
FAMILIES = {  # a second table of units, which knows nothing of the first
    "pressure": {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "mbar": 1e2, "bar": 1e5},
    "angle": {"rad": 1.0, "arcsec": ARCSEC, "mrad": 1e-3, "deg": math.pi / 180, "arcmin": 60 * ARCSEC},
    "voltage": {"V": 1.0, "mV": 1e-3, "uV": 1e-6},
    "current": {"A": 1.0, "mA": 1e-3, "uA": 1e-6},
    "length": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "cm": 1e-2},
    "field": {"uT": 1e-6, "nT": 1e-9, "mT": 1e-3, "gauss": 1e-4},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "mHz": 1e-3},
    "acceleration": {"um/s^2": 1e-6, "m/s^2": 1.0, "mGal": 1e-5, "uGal": 1e-8},
    "rate": {"deg/s": math.pi / 180, "rad/s": 1.0, "deg/h": ARCSEC, "rpm": math.pi / 30},
    "ratio": {"1": 1.0, "%": 1e-2, "ppm": 1e-6, "ppb": 1e-9},
}  # fmt: skip
FORMS = {  # a basis, its columns, and the coefficient's unit
    "a": (lambda a, b: a, ("a",), "{y}/({a})"),
    "a²": (lambda a, b: a**2, ("a",), "{y}/({a})^2"),
    "a·b": (lambda a, b: a * b, ("a", "b"), "{y}/({a})/({b})"),
    "a/b": (lambda a, b: a / b, ("a", "b"), "({y})*({b})/({a})"),
    "a·b²": (lambda a, b: a * b**2, ("a", "b"), "{y}/(({a})*({b})^2)"),
}
QUICK = bc.LeastSquares(draws=500)
BEYOND = 2.5758  # standard deviations, of the central 99 %


class Drawn:
    """An instrument of random units, and readings of it in further random units, made by SI alone."""

    def __init__(self, seed: int, rows: int = 40) -> None:
        random = np.random.default_rng(seed)
        families = [str(family) for family in random.choice([*FAMILIES], 3)]
        size = [FAMILIES[family] for family in families]

        def units() -> list[str]:
            return [str(random.choice([*of])) for of in size]

        (self.y, self.a, self.b), reported, files = units(), units(), units()
        for i, declared in ((1, self.a), (2, self.b)):
            if reported[i] == "1":  # "per 1" is said by no unit
                reported[i] = declared
        self.form, self.columns, unit = FORMS[str(random.choice([*FORMS]))]
        self.unit = unit.format(y=reported[0], a=reported[1], b=reported[2])
        a = random.uniform(1, 3, rows) * size[1][self.a]
        b = random.uniform(1, 3, rows) * size[2][self.b]
        one = size[0][reported[0]] / self.form(size[1][reported[1]], size[2][reported[2]])  # in SI
        si = size[0][self.y]
        self.truth = float(random.uniform(10, 30) * si / np.abs(one * self.form(a, b)).max())
        y = 12.0 * si + self.truth * one * self.form(a, b) + random.normal(0, 0.1 * si, rows)
        made = zip(("output", "a", "b"), (y, a, b), size, files, strict=True)
        self.arrays: dict[str, Any] = {name: values / of[file] for name, values, of, file in made}
        self.files: dict[str, str] = dict(zip(("output", "a", "b"), files, strict=True))

    def instrument(self) -> bc.Instrument:
        slope = bc.Effect(
            "zero.slope",
            "zero",
            basis=lambda r: self.form(r["a"], r["b"]),
            coefficients=(bc.Coefficient(self.unit, bc.Normal(0.0, 10 * self.truth)),),
            columns=self.columns,
        )
        return bc.Instrument(
            name="drawn",
            title="an instrument of random units",
            columns=(bc.Column("a", self.a), bc.Column("b", self.b), bc.Column("output", self.y)),
            slots=(bc.Slot("zero", self.y),),
            response=lambda slots, r: slots["zero"],
            effects=(effects.constant("zero", 100.0, self.y, source="made up"), slope),
            noise=bc.White(bc.HalfCauchy(0.1)),
        )


def standing(seed: int) -> float | str:
    """How many standard deviations from the truth the coefficient stands; why it was refused, where it was."""
    drawn = Drawn(seed)
    try:
        instrument = drawn.instrument()
    except bc.ModelError as refused:
        return str(refused)
    readings = bc.Measurements.from_arrays(instrument, units=drawn.files, **drawn.arrays)
    found = bc.fit(instrument.baseline(), readings, QUICK, strict=False)
    draws = found.samples("zero.slope")
    return float((draws.mean() - drawn.truth) / draws.std())


def test_forty_instruments_of_random_units_are_right_or_refused() -> None:
    standings = map(standing, range(40))
    wrong = [s for s in standings if not isinstance(s, str) and abs(s) > BEYOND]
    assert not wrong


@pytest.mark.parametrize(
    ("column", "base", "unit", "factor"),
    [
        ("humidity", "1", "deg/s/%", 100.0),
        ("pressure", "Pa", "deg/s/hPa", 0.01),
        ("acceleration", "ug", "deg/s/g", 1e-6),  # of local g
    ],
)
def test_a_column_that_no_instrument_declares_comes_in_base_units(
    column, base, unit, factor
) -> None:
    own = bc.Effect(
        "bias.own",
        "bias",
        basis=lambda r: r[column],
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, 10.0)),),
        columns=(column,),
    )
    values, random = np.linspace(0.2, 0.8, 200), np.random.default_rng(1)
    output = factor * (3.0 * values + 1e-3 * random.standard_normal(200))
    columns = {column: values, "temperature": np.tile([20.0, 40.0], 100), "output": output}
    readings = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, units={column: base}, **columns)
    model = (mems_gyro.INSTRUMENT.baseline() + own).with_noise(bc.White(bc.HalfCauchy(factor)))
    found = bc.fit(model, readings, QUICK).samples("bias.own")
    assert found.mean() == pytest.approx(3.0, abs=5 * found.std()) and found.std() < 0.01
