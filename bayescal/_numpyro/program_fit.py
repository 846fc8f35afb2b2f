"""The result of fitting a user's own NumPyro program."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import numpy as np
import xarray as xr
from arviz_base import from_dict

from bayescal._core.errors import InputError
from bayescal._core.formatting import WIDTH, table, with_error
from bayescal._inference.method import Verdict
from bayescal._numpyro.trace import TracedProgram

ROWS = 40  # lines of a printed table


@dataclass(frozen=True, eq=False)
class ProgramFit:
    """The result of fitting a NumPyro program.

    Attributes:
        name: of the program.
        tree: ArviZ DataTree: posterior (every unknown and every `numpyro.deterministic`), observed_data. Axes that
            belong to a plate carry its name.
        verdict: whether to trust it, and what was done.
        method: name of the method.
        seed: of every random number.
        log_evidence: (value, Monte-Carlo error or None); None where a prior is improper or all was sampled.
        marginalised: sites that were integrated out in closed form.
        sampled: the other unknowns.
    """

    name: str
    tree: xr.DataTree
    verdict: Verdict
    method: str
    seed: int
    log_evidence: tuple[float, float | None] | None
    marginalised: tuple[str, ...]
    sampled: tuple[str, ...]

    def samples(self, name: str) -> np.ndarray:
        """All draws of one site, (draws, …) with the shape that the program gives it.

        Raises:
            InputError: nothing is called so.
        """
        posterior = self.tree["posterior"].to_dataset()
        if name not in posterior.data_vars:
            known = ", ".join(map(str, posterior.data_vars))
            raise InputError(f"no site of {self.name!r} is called {name!r}; there are: {known}")
        values = posterior[name].values
        return values.reshape(-1, *values.shape[2:])

    def __str__(self) -> str:
        rows = []
        for name in (*self.marginalised, *self.sampled):
            draws = self.samples(name)
            for place in np.ndindex(draws.shape[1:]):
                one = draws[(slice(None), *place)]
                low, high = np.quantile(one, [0.025, 0.975])
                entry = f"{name}[{', '.join(map(str, place))}]" if place else name
                value = with_error(float(one.mean()), float(one.std()))
                rows.append([entry, value, f"{low:.4g} to {high:.4g}"])
        head = ["unknown", "mean ± standard uncertainty", "95 % credible interval"]
        lines = [table(head, rows[:ROWS])]
        if len(rows) > ROWS:
            lines.append(f"… and {len(rows) - ROWS} more, by samples(name)")
        return "\n".join([*lines, textwrap.fill(str(self.verdict), WIDTH)])


def tree_of(
    program: TracedProgram, values: dict[str, np.ndarray], observed: dict[str, np.ndarray]
) -> xr.DataTree:
    """Draws (chains, draws, …) and observed values by site; axes that belong to a plate carry its name."""
    dims = {}
    for site in (*program.latent, *program.observed):
        names = [
            f"{site.name}_dim_{i}" if d is None or d in values or d in observed else d
            for i, d in enumerate(site.dims)
        ]
        if len(set(names)) == len(names):
            dims[site.name] = names
    groups = {"posterior": values}
    if observed:
        groups["observed_data"] = observed
    return from_dict(groups, dims=dims)
