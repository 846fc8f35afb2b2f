"""The result of a fit: printed, converted to an ArviZ tree, saved to NetCDF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayescal._calibration.claim import Claim
from bayescal._calibration.fitted import MAX_CELLS, Fitted, replicate, to_xarray
from bayescal._calibration.judgement import Subject, check_reading_count, conflicts, group_conflicts
from bayescal._calibration.storage import save
from bayescal._calibration.summary import list_unknowns, null_directions, summary
from bayescal._core.atomic_file import encode_name
from bayescal._core.flag import Flag
from bayescal._core.formatting import wrap
from bayescal._core.result_table import Printed, ResultTable
from bayescal._inference.sampling import draw_prior
from bayescal._model.model import format_model

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

PRIOR_DRAWS = 1000  # of the group `prior`: enough to plot a prior density


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Printed, Fitted):
    """A fitted model: joint posterior draws, verdict, and the results computed from them.

    Attributes:
        model: the fitted model.
        readings: the measurements that it was fitted to.
        joint: equally weighted joint posterior draws, from which results are computed on first access.
        verdict: convergence diagnosis and failed acceptance checks.
        method: name of the inference method.
        seed: seed of the random-number generator.
        reference: constants of the basis functions by name, such as T0.
        levels: member names of each group.
        layout: index of each unknown in the coefficient vector x and the hyperparameter vector φ.
        mode: posterior mode φ̂, x̂: the expansion point of the linearised model.
        log_evidence: log evidence and its Monte-Carlo standard error (or None); None if a prior is flat.
        start: starting values of φ by name for the mode search, besides prior draws; usually empty.
        form_factor: factor on the expected output's standard uncertainty for model inadequacy; 1 without a search.
        unfound_spreads: between-run sd of plausible effects that the search did not add, by effect, coefficient's unit.
    """

    def _list_parts(self) -> list[str | ResultTable]:
        return [*list_unknowns(self), self.remarks]

    @property
    def remarks(self) -> str:
        """Return unidentified directions, the verdict, conflicts and failed checks, one per line."""
        claim_keys = {(claim.code, claim.subjects) for claim in self.conflicts}
        failures = self.verdict.against
        other_failures = (
            f for f in failures if not isinstance(f, Flag) or (f.code, f.subjects) not in claim_keys
        )
        lines = [
            *(f"not measured: {direction}" for direction in null_directions(self)),
            *self.verdict.sentences,
            *(f"conflict: {conflict}" for conflict in self.conflicts),
            *(f"not reliable: {conflict}" for conflict in other_failures),
        ]
        return "\n".join(map(wrap, lines))

    def _format_summary(self) -> str:
        status = "converged" if self.verdict.ok else "NOT converged"
        status = "NOT reliable" if self.verdict.against else status
        return f"{status}, {len(self.readings)} readings of {self.readings.file}, {format_model(self.model)}"

    def _list_columns(self) -> dict[str, list[Any]]:
        """Return table columns by name, an entry per unknown, in its unit; `low`, `high`: 95 % credible interval."""
        rows = [row for part in summary(self) for row in part]
        return {
            "unknown": [r["name"] for r in rows],
            **{name: [r[name] for r in rows] for name in ("effect", "unit", "mean", "sd")},
            "low": [r["interval95"][0] for r in rows],
            "high": [r["interval95"][1] for r in rows],
            "contraction": [r["contraction"] for r in rows],
        }

    @property
    def covariance(self) -> pd.DataFrame:
        """Return the posterior covariance of all unknowns by name, in products of their units."""
        import pandas as pd

        names = self.unknowns.names
        values = self.values.reshape(-1, len(names))
        return pd.DataFrame(np.atleast_2d(np.cov(values.T)), names, names)

    @property
    def correlation(self) -> pd.DataFrame:
        """Return the posterior correlations of all unknowns by name."""
        covariance = self.covariance
        standard_deviations = np.sqrt(np.diag(covariance))
        return covariance / np.outer(standard_deviations, standard_deviations)

    @cached_property
    def conflicts(self) -> tuple[Claim, ...]:
        """Return claims: readings that contradict priors, implausible group members, too few readings."""
        subject = Subject(self)
        return (*conflicts(subject), *group_conflicts(subject), *check_reading_count(subject))

    @cached_property
    def tree(self) -> xr.DataTree:
        """Build the ArviZ DataTree on first access, since replicated readings take time and memory.

        Groups: posterior, prior (if proper), posterior_predictive, observed_data, constant_data.
        """
        import xarray as xr

        readings, dims = self.readings, ("chain", "draw", "reading")
        units = {"units": readings.unit("output")}
        draws, chains = self.thin_draws(MAX_CELLS)
        outputs = replicate(self.problem, draws, np.random.default_rng([self.seed, 1]))
        outputs = outputs.reshape(chains, -1, len(readings))
        outputs += readings["output"] - self.frame["output"]
        groups = {
            "posterior": self.posterior,
            "posterior_predictive": xr.Dataset({"output": (dims, outputs, units)}),
            "observed_data": xr.Dataset({"output": ("reading", readings["output"], units)}),
            "constant_data": readings.to_xarray().drop_vars("output"),
        }
        groups = {n: _prepare_for_netcdf(g, self.joint.x.shape[1]) for n, g in groups.items()}
        if not self.layout.is_improper:
            prior_draws = to_xarray(self.unknowns, self.unknowns.values(*_draw_from_prior(self)))
            groups["prior"] = _prepare_for_netcdf(prior_draws, PRIOR_DRAWS)
        return xr.DataTree.from_dict(groups)

    def with_log_likelihood(self) -> xr.DataTree:
        """Return a copy of `tree` with the group `log_likelihood`, (chain, draw, reading), for `arviz_stats.loo`.

        The copy is not cached. Draws are thinned so that a group has at most two million numbers (draws × readings).
        Under correlated noise the log likelihood is conditional on the earlier readings of the run.
        """
        import xarray as xr

        draws_per_chain = self.joint.x.shape[1]
        log_likelihood = _prepare_for_netcdf(self.log_likelihood(), draws_per_chain)
        groups = {name: child.to_dataset() for name, child in self.tree.children.items()}
        for name, group in groups.items():
            if name != "prior" and group.sizes.get("draw") == draws_per_chain:
                groups[name] = group.isel(draw=log_likelihood["draw"].values)
        return xr.DataTree.from_dict({**groups, "log_likelihood": log_likelihood})

    def save(self, path: str | Path) -> Path:
        """Write the calibration to NetCDF (*.nc) and return the path; InputError if that fails. `bc.load` reads it."""
        return save(self, Path(path))


def _prepare_for_netcdf(group: xr.Dataset, draws_per_chain: int) -> xr.Dataset:
    """Return a group with names valid in NetCDF, and coordinates of chain and draw (indices before thinning)."""
    import pandas as pd

    if "draw" in group.sizes:  # ArviZ's plots need the coordinates
        thinning = -(-draws_per_chain // group.sizes["draw"])
        # Indices of pandas: xarray would load Dask to look at arrays.
        draws = pd.RangeIndex(0, thinning * group.sizes["draw"], thinning)
        group = group.assign_coords(chain=pd.RangeIndex(group.sizes["chain"]), draw=draws)
    names = {str(n): encode_name(str(n)) for n in (*group.variables, *group.dims)}
    return group.rename({name: new_name for name, new_name in names.items() if name != new_name})


def _draw_from_prior(fit: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Draw coefficients x (1, draws, p) and coordinates v of φ (1, draws, d) from the prior, as one chain."""
    rng, v = np.random.default_rng([fit.seed, 2]), np.zeros((PRIOR_DRAWS, len(fit.layout.hypers)))
    for i, h in enumerate(fit.layout.hypers):
        v[:, i] = draw_prior(h.prior, rng, PRIOR_DRAWS)
    sd = fit.problem.prior(fit.problem.hyper(v.T), np.ones(fit.problem.size), (PRIOR_DRAWS,)).sd
    return (fit.problem.mean_of_x + sd * rng.standard_normal(sd.shape))[None], v[None]
