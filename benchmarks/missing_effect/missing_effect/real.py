"""Real records with a known answer: NIST's reference data for linear regression, a term of the certified model hidden.

The data are not part of this package: they are read from a folder that the user has, `NAME.dat` as NIST gives them or
`name.csv` with columns, the response first. Every fifth reading is held out.
Source: NIST, Statistical Reference Datasets, https://www.itl.nist.gov/div898/strd. Pontius: a load cell, whose
certified model is quadratic. Norris: ozone monitors, whose certified model is a line.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from missing_effect.generate import Made, write
from missing_effect.task import Task, Term

HELD = 5  # every so many


class Known(NamedTuple):
    """A data set: what it is, and the order of its certified polynomial."""

    words: str
    order: int


SETS = {"Pontius": Known("deflection of a load cell", 2), "Norris": Known("ozone monitors", 1)}
HIGHEST = 4  # order of the candidates' powers


def generate(folder: Path, tasks: Path) -> Iterator[str]:
    """Write the real tasks whose data are there, and say of each whether they were."""
    for name, known in SETS.items():
        found = _read(folder, name)
        if found is None:
            yield f"skipped {name}: neither {name}.csv nor {name}.dat is in {folder}"
        else:
            write(_made(name, known, *found), tasks / f"task_real_{name.lower()}")
            yield f"made task_real_{name.lower()}: {known.words}"


def _read(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Response and predictor, (n,) each; None where there is no file."""
    tables = [folder / f"{n}.csv" for n in (name, name.lower()) if (folder / f"{n}.csv").is_file()]
    certificate = folder / f"{name}.dat"
    if tables:
        values = np.loadtxt(tables[0], delimiter=",", skiprows=1)
    elif certificate.is_file():  # data begin at line 61, as each of these files says in its head
        values = np.loadtxt(certificate, skiprows=60)
    else:
        return None
    return values[:, 0], values[:, 1]


def _made(name: str, known: Known, y: np.ndarray, x: np.ndarray) -> Made:
    middle, half = (x.max() + x.min()) / 2, (x.max() - x.min()) / 2
    certified = np.polynomial.Polynomial.fit(x, y, known.order)
    noise = float(np.sqrt(np.sum((y - certified(x)) ** 2) / (y.size - known.order - 1)))
    held = np.arange(y.size) % HELD == HELD // 2
    frame = pd.DataFrame({"x": x, "output": y})

    def term(order: int, size: float) -> Term:
        arguments = {"column": "x", "about": float(middle), "order": order}
        words = f"c·(x − {middle:g})^{order}"
        return Term(f"power_{order}", words, "power", arguments, f"1/x^{order}", size / half**order)

    vast = float(np.ptp(y))
    base = (Term("constant", "c", "constant", {}, "1", 10 * vast), term(1, 10 * vast))
    candidates = tuple(term(order, 3 * noise) for order in range(2, HIGHEST + 1))
    hidden = [f"power_{order}" for order in range(2, known.order + 1)]
    train, later = (frame.loc[at].reset_index(drop=True) for at in (~held, held))
    task = Task(
        f"real_{name.lower()}", "1", {"x": "1", "output": "1"}, train,
        later.drop(columns="output"), base, candidates,
    )  # fmt: skip
    truth = {
        "track": "real",
        "instrument": name,
        "set": hidden,
        "decided": None,
        "equivalent": [],
        "noise_sd": noise,
        "holdout": [float(v) for v in y[held]],
        "expected": [float(v) for v in certified(x[held])],
    }
    return Made(task, {"x": 9, "output": 9}, truth)
