"""The result of a fit: printed, converted to an ArviZ tree, saved to NetCDF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayescal._calibration.claim import Claim
from bayescal._calibration.fitted import Fitted
from bayescal._calibration.judgement import Subject, conflicts, group_conflicts, too_few
from bayescal._calibration.storage import save
from bayescal._calibration.summary import null_directions, summary, unknowns_parts
from bayescal._core.flag import Flag
from bayescal._core.formatting import folded
from bayescal._core.result_table import Printed, ResultTable
from bayescal._model.model import format_model

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Printed, Fitted):
    """The result of a fit.

    Attributes:
        model: what was fitted.
        readings: to what.
        joint: equally weighted joint draws, from which everything else is computed when it is asked for.
        verdict: whether to trust it.
        method: name of the method.
        seed: of every random number.
        reference: constants of the bases: T0, run starts …
        levels: members of each group.
        layout: where each unknown stands.
        mode: φ̂ and x̂, at which everything is linearised.
        log_evidence: (value, Monte-Carlo error or None), None where a prior is flat.
        start: φ by name, a starting point for its mode besides the prior draws; empty for most.
        form_factor: multiplies the standard uncertainty of the expected output, for formulas absent from a search; 1
            if the formula is known.
        unfound_spreads: standard deviations between new runs that no draw has, by effect not found; in the unit
            of its coefficient.
    """

    def _parts(self) -> list[str | ResultTable]:
        return [*unknowns_parts(self), self.remarks]

    @property
    def remarks(self) -> str:
        """Return unidentified directions, the verdict, conflicts and failed checks, one per line."""
        stated = {(claim.code, claim.subjects) for claim in self.conflicts}
        against = self.verdict.against
        further = (
            f for f in against if not isinstance(f, Flag) or (f.code, f.subjects) not in stated
        )
        lines = [
            *(f"not measured: {direction}" for direction in null_directions(self)),
            str(self.verdict),
            *(f"conflict: {conflict}" for conflict in self.conflicts),
            *(f"not reliable: {conflict}" for conflict in further),
        ]
        return "\n".join(folded(line, "") for line in lines)

    def _brief(self) -> str:
        verdict = "converged" if self.verdict.ok else "NOT converged"
        verdict = "NOT reliable" if self.verdict.against else verdict
        return f"{verdict}, {len(self.readings)} readings of {self.readings.file}, {format_model(self.model)}"

    def _columns(self) -> dict[str, list[Any]]:
        """Return one row per unknown, in its unit; `low` and `high` bound the 95 % credible interval."""
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
        sd = np.sqrt(np.diag(covariance))
        return covariance / np.outer(sd, sd)

    @cached_property
    def conflicts(self) -> tuple[Claim, ...]:
        """Return contradictions of readings and priors, implausible group members, and too few readings."""
        subject = Subject(self)
        return (*conflicts(subject), *group_conflicts(subject), *too_few(subject))

    @cached_property
    def tree(self) -> xr.DataTree:
        """Build the ArviZ DataTree, on first access: replicated readings take time and memory.

        Groups: posterior, prior, posterior_predictive, log_prior, sample_stats, observed_data, constant_data, and the
        joint draws as plain vectors.
        """
        from bayescal._calibration.posterior_tree import build_tree  # and xarray with it

        return build_tree(self)

    def with_log_likelihood(self) -> xr.DataTree:
        """Return a copy of `tree` with the group `log_likelihood`, (chain, draw, reading), for `arviz_stats.loo`.

        Not cached: its size is draws times readings; above two million numbers the draws are thinned,
        in all groups alike. Under correlated noise it is conditional on the earlier readings of the run.
        """
        from bayescal._calibration.posterior_tree import with_log_likelihood

        return with_log_likelihood(self.tree, self)

    def save(self, path: str | Path) -> Path:
        """Write draws, mode and readings to NetCDF, atomically. `bc.load` reads them back."""
        return save(self, Path(path))
