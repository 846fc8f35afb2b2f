"""Public records with a known answer: NIST's certified models with hidden terms, and a real record with added effects.

The data are not part of this package: they are read from a folder of the user, or its subfolders. NIST's sets are
`NAME.dat` as published, or `name.csv` with columns, the response first; the sensor at rest in a chamber is
`imu_thermal_ramp.csv` with columns t_s, temperature and six channels. Every fifth reading is hold-out data.
Sources: NIST, Statistical Reference Datasets, https://www.itl.nist.gov/div898/strd (public domain); the parameters of
the models below are certified. The ramp: github.com/tofupilot/examples, templates/imu_thermal_calibration (MIT).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from missing_effect.draws import Draws
from missing_effect.run import InputError
from missing_effect.task import Task, Term

from missing_effect_maker.generate import GeneratedTask, write
from missing_effect_maker.simulate.bodies import body

Array = np.ndarray
HOLDOUT_STEP = 5  # every so many
AGREES = 1e-6  # relative difference of the residuals' standard deviation from the certified one
RAMP = "imu_thermal_ramp.csv"
AVERAGED = 40  # rows of the ramp in a reading: 210 readings, 20 s apart
FOLLOWING = (150.0, 600.0)  # s, time constants of bodies behind the board's thermometer
WIDTH = {"width": (10.0, 50.0)}  # channels, of a Gaussian peak that is not known
ORDER = 5  # of the known polynomial in temperature
ADDED = {"gyro_x": (), "gyro_y": ("field",), "gyro_z": (), "acc_x": ("supply_squared",),
         "acc_y": ("field", "humidity"), "acc_z": ()}  # fmt: skip


class CertifiedSet(NamedTuple):
    """A record, its certified model, and the hidden part of that model.

    Attributes:
        words: description of the record.
        curve: the certified model, a function of the predictor.
        parameters: certified parameters.
        residual_sd: certified residual standard deviation, response unit.
        base: terms of the task's model.
        candidates: the other terms.
        hidden: names of the candidates that the certified model contains.
    """

    words: str
    curve: Callable[[Array], Array]
    parameters: int
    residual_sd: float
    base: tuple[Term, ...]
    candidates: tuple[Term, ...]
    hidden: tuple[str, ...]


def generate(folder: Path, tasks: Path) -> Iterator[str]:
    """Write the real tasks whose data are in a folder; yield a line on each, written or skipped.

    Raises:
        InputError: readings of a file are not those that NIST certified.
    """
    for name, certified in nist().items():
        file = next((f for n in (f"{name.lower()}.csv", f"{name}.csv", f"{name}.dat")
                     for f in sorted(folder.rglob(n))), None)  # fmt: skip
        if file is None:
            yield f"skipped {name}: neither {name}.dat nor {name.lower()}.csv is in {folder}"
        else:
            write(_of_nist(name, certified, file), tasks / f"task_real_{name.lower()}")
            yield f"made task_real_{name.lower()}: {certified.words}"
    ramp = next(iter(sorted(folder.rglob(RAMP))), None)
    if ramp is None:
        yield f"skipped the chamber ramp: {RAMP} is not in {folder}"
    else:
        for channel, added in ADDED.items():
            write(_of_ramp(ramp, channel, added), tasks / f"task_real_ramp_{channel}")
            yield f"made task_real_ramp_{channel}: one channel of a sensor at rest in a chamber"


def nist() -> dict[str, CertifiedSet]:
    """Return the data sets by NIST's name."""
    sets = {
        "Pontius": _polynomial(
            "deflection of a load cell, whose certified model is quadratic", 2.05177424076185e-4,
            (6.73565789473684e-4, 7.32059160401003e-7, -3.16081871345029e-15), 1.575e6, 1.425e6,
        ),
        "Norris": _polynomial(
            "ozone monitors, whose certified model is a line", 0.884796396144373,
            (-0.262323073774029, 1.00211681802045), 500.0, 500.0,
        ),
        "ENSO": _oscillation(),
    }  # fmt: skip
    for name, sd, b in (
        ("Gauss1", 2.331798018, (98.778210871, 0.010497276517, 100.48990633, 67.481111276,
                                 23.12977336, 71.994503004, 178.99805021, 18.389389025)),
        ("Gauss2", 2.2704790782, (99.018328406, 0.010994945399, 101.88022528, 107.03095519,
                                  23.578584029, 72.045589471, 153.27010194, 19.525972636)),
        ("Gauss3", 2.2677077625, (98.94036897, 0.010945879335, 100.69553078, 111.63619459,
                                  23.300500029, 73.705031418, 147.76164251, 19.66822123)),
    ):  # fmt: skip
        sets[name] = _peaks(sd, *b)
    return sets


def _term(
    name: str,
    words: str,
    formula: str,
    size: float,
    shapes: dict[str, tuple[float, float]] | None = None,
    **arguments: float,
) -> Term:
    """Build a term in the predictor x."""
    column = {} if formula == "constant" else {"column": "x"}
    return Term(name, words, formula, {**column, **arguments}, "1", size, shapes or {})


def _polynomial(
    words: str, sd: float, b: Sequence[float], middle: float, half: float, highest: int = 4
) -> CertifiedSet:
    """Return a set whose base is a line and whose candidates are higher powers."""

    def term(order: int, size: float) -> Term:
        text = f"c·(x − {middle:g})^{order}"
        return _term(f"power_{order}", text, "power", size / half**order, about=middle, order=order)

    vast = 1e4 * sd + 10 * abs(b[1]) * half
    base = (_term("constant", "c", "constant", vast), term(1, vast))
    hidden = tuple(f"power_{order}" for order in range(2, len(b)))
    candidates = tuple(term(order, 3 * sd) for order in range(2, highest + 1))
    return CertifiedSet(words, np.polynomial.Polynomial(b), len(b), sd, base, candidates, hidden)


def _oscillation() -> CertifiedSet:
    """Return the set whose base is the annual cycle and whose candidates are slower cycles."""
    b = (10.510749193, 3.0762128085, 0.53280138227, 44.3110887, -1.6231428586, 0.52554493756,
         26.88761444, 0.21232288488, 1.4966870418)  # fmt: skip
    sd = 2.2269642403

    def curve(x: Array) -> Array:
        at = [2 * np.pi * x / period for period in (12.0, b[3], b[6])]
        sizes = ((b[1], b[2]), (b[4], b[5]), (b[7], b[8]))
        cycles = (p * np.cos(a) + q * np.sin(a) for a, (p, q) in zip(at, sizes, strict=True))
        return sum(cycles, start=np.full(x.size, b[0]))

    def cycle(months: int, size: float) -> Term:
        words = f"c₁·cos(2π·x/{months}) + c₂·sin(2π·x/{months}), x in months"
        return _term(f"cycle_{months}", words, "harmonic", size, period=float(months))

    drift = _term("drift", "c·(x − 84)", "power", sd / 84, about=84.0, order=1)
    candidates = (*(cycle(months, sd) for months in (6, 9, 18, 26, 34, 44, 60)), drift)
    words = "pressure between Easter Island and Darwin, whose certified model has three cycles"
    base = (_term("constant", "c", "constant", 1e3 * sd), cycle(12, 1e3 * sd))
    return CertifiedSet(words, curve, len(b), sd, base, candidates, ("cycle_26", "cycle_44"))


def _peaks(sd: float, *b: float) -> CertifiedSet:
    """Return a set whose base is the decay and the first peak, and whose candidates are further peaks."""

    def curve(x: Array) -> Array:
        first, second = (np.exp(-(((x - b[i]) / b[i + 1]) ** 2)) for i in (3, 6))
        return b[0] * np.exp(-b[1] * x) + b[2] * first + b[5] * second

    def peak(centre: float) -> Term:
        words = f"c·exp(−((x − {centre:g})/width)²)"
        return _term(f"peak_{centre:.0f}", words, "peak", 100.0, WIDTH, centre=centre)

    near, far = round(b[3], 2), round(b[6], 2)
    peaks = _term(
        "known_peak", f"c·exp(−((x − {near:g})/{b[4]:g})²)", "peak", 1e3 * sd,
        centre=b[3], width=b[4],
    )  # fmt: skip
    decay = _term("decay", f"c·exp(−{b[1]:g}·x)", "decay", 1e3 * sd, scale=1 / b[1])
    slope = _term("slope", "c·(x − 125)", "power", 3 * sd / 125, about=125.0, order=1)
    bow = _term("bow", "c·(x − 125)²", "power", 3 * sd / 125**2, about=125.0, order=2)
    others = (31.42, 92.71, 203.58, 231.13)
    words = "generated by NIST: two Gaussians on a decay, with normal noise"
    candidates = (*map(peak, (far, *others)), slope, bow)
    return CertifiedSet(words, curve, len(b), sd, (decay, peaks), candidates, (f"peak_{far:.0f}",))


def _of_nist(name: str, certified: CertifiedSet, file: Path) -> GeneratedTask:
    # Data begin at line 61 of NIST's own files, as each says in its head.
    csv = file.suffix == ".csv"
    try:
        layout = {"delimiter": "," if csv else None, "skiprows": 1 if csv else 60}
        y, x = np.loadtxt(file, ndmin=2, usecols=(0, 1), unpack=True, **layout)
    except ValueError as error:
        raise InputError(
            f"{file} cannot be read as NIST's {name}, two columns of numbers, the response first: {error}"
        ) from None
    free = max(1, y.size - certified.parameters)
    spread = float(np.sqrt(np.sum((y - certified.curve(x)) ** 2) / free))
    if abs(spread / certified.residual_sd - 1) > AGREES:
        raise InputError(
            f"{file} is not NIST's {name}: the residual standard deviation of its {y.size} readings is {spread:.10g}, "
            f"the certified one {certified.residual_sd:.10g}. Download the file from NIST again, or remove it"
        )
    frame = pd.DataFrame({"x": x, "output": y})
    return _real_task(name, frame, {"x": 9, "output": 9}, certified, certified.curve(x))


def _of_ramp(file: Path, channel: str, added: Sequence[str]) -> GeneratedTask:
    """Return a task whose noise is a channel of the ramp: the form of its temperature dependence is known, and some
    artificial quantities, or none, contribute to it."""
    record = pd.read_csv(file)
    missing = [c for c in ("t_s", "temperature", channel) if c not in record]
    if missing:
        raise InputError(
            f"{file} has no column {', '.join(missing)} (it has: {', '.join(map(str, record))}). "
            "Name the columns t_s, temperature, gyro_x to gyro_z and acc_x to acc_z, or remove the file"
        )
    rows = len(record) // AVERAGED * AVERAGED
    parts = record.iloc[:rows].groupby(np.arange(rows) // AVERAGED)
    time, temperature = (parts[c].mean().to_numpy() for c in ("t_s", "temperature"))
    output = parts[channel].median().to_numpy()  # two rows are spikes
    step, draws = float(np.mean(np.diff(time))), Draws(list(ADDED).index(channel), 2026)
    columns = {"time": time, "temperature": temperature}
    columns |= {f"behind_{tau:g}": body(temperature, step, tau) for tau in FOLLOWING}
    columns |= {name: draws.wave(len(time), 40) for name in ("supply", "humidity", "field")}
    columns = {name: np.round(values, 4) for name, values in columns.items()}
    frame = pd.DataFrame(columns)

    def power(name: str, column: str, about: float, order: int, size: float) -> Term:
        words = f"c·({column} − {about:g})^{order}" if about else f"c·{column}^{order}"
        arguments = {"column": column, "about": about, "order": order}
        return Term(name, words, "power", arguments, "1", size)

    middle, half = round(float(temperature.mean())), float(np.ptp(temperature)) / 2
    vast = 1e3 * float(output.std())
    base = (
        Term("constant", "c", "constant", {}, "1", vast),
        *(power(f"temperature_{k}", "temperature", middle, k, vast / half**k)
          for k in range(1, ORDER + 1)),
        *(power(f"behind_{tau:g}", f"behind_{tau:g}", middle, 1, vast / half) for tau in FOLLOWING),
        power("drift", "time", round(float(time.mean())), 1, vast / float(time.max())),
    )  # fmt: skip
    x = np.hstack([t.columns(frame) for t in base])
    scaled = x / np.abs(x).max(axis=0)
    fitted = scaled @ np.linalg.lstsq(scaled, output, rcond=None)[0]
    noise = float(np.std(output - fitted) * np.sqrt(len(time) / (len(time) - x.shape[1])))
    candidates = (
        *(power(name, name, 0.0, 1, noise) for name in ("supply", "humidity", "field")),
        *(power(f"{name}_squared", name, 0.0, 2, noise) for name in ("supply", "humidity", "field")),
        *(Term(f"{name}_temperature", f"c·{name}·(temperature − {middle})", "product",
               {"first": name, "second": "temperature", "about": middle}, "1", noise / half * 2)
          for name in ("supply", "field")),
    )  # fmt: skip
    sizes = {name: draws.sign() * draws.ratio(1.0, 3.0) * noise for name in added}
    adds = sum(
        (sizes[t.name] * t.columns(frame)[:, 0] for t in candidates if t.name in sizes),
        start=np.zeros(len(time)),
    )
    hidden = tuple(sorted(added))
    certified = CertifiedSet(
        "", np.asarray, 0, noise, base, tuple(draws.shuffled(candidates)), hidden
    )
    frame = frame.assign(output=output + adds)
    places = {**dict.fromkeys(columns, 4), "output": 9}
    return _real_task(f"ramp_{channel}", frame, places, certified, fitted + adds)


def _real_task(
    name: str, frame: pd.DataFrame, decimals: dict[str, int], known: CertifiedSet, expected: Array
) -> GeneratedTask:
    holdout = np.arange(len(frame)) % HOLDOUT_STEP == HOLDOUT_STEP // 2
    train, later = (frame.loc[at].reset_index(drop=True) for at in (~holdout, holdout))
    task = Task(
        f"real_{name.lower()}", "1", dict.fromkeys(map(str, frame), "1"), train,
        later.drop(columns="output"), known.base,
        tuple(Draws(*name.encode()).shuffled(known.candidates)),
    )  # fmt: skip
    truth = {
        "track": "real",
        "instrument": name,
        "set": sorted(known.hidden),
        "decided": None,
        "equivalent": [],
        "noise_sd": known.residual_sd,
        "holdout": [float(v) for v in later["output"]],
        "expected": [float(v) for v in expected[holdout]],
    }
    return GeneratedTask(task, decimals, truth)
