"""NUTS on the models that are written out in NumPyro, by the lines that an instrument's `as_numpyro.py` prints."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax
import numpy as np
from numpyro.infer import MCMC, NUTS

import bayescal as bc
from bayescal_models.mems_gyro import as_numpyro as mems_gyro


def draws(module: ModuleType, readings: bc.Measurements, seed: int = 0) -> dict[str, np.ndarray]:
    """Draws of every site, by its name, of one chain."""
    said = module if "nuts = " in str(module.__doc__) else mems_gyro
    lines = [line.strip() for line in str(said.__doc__).splitlines()]
    at = next(i for i, line in enumerate(lines) if line.startswith("nuts = "))
    names: dict[str, Any] = {**vars(module), "NUTS": NUTS, "MCMC": MCMC, "readings": readings}
    with jax.enable_x64(True):
        names["key"] = jax.random.key(seed)
        exec(lines[at], names)
        made, run = lines[at + 1].split(".run", 1)
        chain = eval(made.replace(")", ", progress_bar=False)"), names)
        eval(f"chain.run{run}", {**names, "chain": chain})
    return {name: np.asarray(values) for name, values in chain.get_samples().items()}
