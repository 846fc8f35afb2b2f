"""What a fit returns, with all that it offers: it prints itself, is an ArviZ tree, and is saved."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayescal._calibration.claim import Claim
from bayescal._calibration.fitted import Fitted
from bayescal._calibration.judgement import Subject, conflicts, group_conflicts, too_few
from bayescal._calibration.storage import save
from bayescal._calibration.summary import null_directions, summary, unknowns_parts
from bayescal._core.flag import Flag
from bayescal._core.formatting import folded
from bayescal._core.result_table import Printed, ResultTable
from bayescal._model.model import in_short

if TYPE_CHECKING:
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
        start: φ by name where its mode was looked for beside the prior draws; empty for most.
        form_factor: on the standard uncertainty of the expected output, for formulas that a search does not have; 1 for
            a fit of a formula that is known.
        unfound_spreads: standard deviations of new runs that no draw has, by the effect that was not found; in the unit
            of its coefficient.
    """

    def _parts(self) -> list[str | ResultTable]:
        return [*unknowns_parts(self), self.remarks]

    @property
    def remarks(self) -> str:
        """What was not measured, the verdict, and what stands against the result, a line each."""
        told = {(one.code, one.of) for one in self.conflicts}
        further = (
            w for w in self.verdict.against if not isinstance(w, Flag) or (w.code, w.of) not in told
        )
        lines = [
            *(f"not measured: {one}" for one in null_directions(self)),
            str(self.verdict),
            *(f"conflict: {words}" for words in self.conflicts),
            *(f"not reliable: {words}" for words in further),
        ]
        return "\n".join(folded(line, "") for line in lines)

    def _brief(self) -> str:
        verdict = "converged" if self.verdict.ok else "NOT converged"
        verdict = "NOT reliable" if self.verdict.against else verdict
        return f"{verdict}, {len(self.readings)} readings of {self.readings.file}, {in_short(self.model)}"

    def _columns(self) -> dict[str, list[Any]]:
        """A row for each unknown, in its own unit; `low` and `high` bound the 95 % credible interval."""
        rows = [row for part in summary(self) for row in part]
        return {
            "unknown": [r["name"] for r in rows],
            **{name: [r[name] for r in rows] for name in ("effect", "unit", "mean", "sd")},
            "low": [r["interval95"][0] for r in rows],
            "high": [r["interval95"][1] for r in rows],
            "contraction": [r["contraction"] for r in rows],
        }

    @cached_property
    def conflicts(self) -> tuple[Claim, ...]:
        """Where readings and priors contradict each other, and what else a fit may not be."""
        subject = Subject(self)
        return (*conflicts(subject), *group_conflicts(subject), *too_few(subject))

    @cached_property
    def tree(self) -> xr.DataTree:
        """The ArviZ DataTree, made when it is first looked at: replicated readings take time and memory.

        Groups: posterior, prior, posterior_predictive, log_prior, sample_stats, observed_data, constant_data, and the
        joint draws as plain vectors.
        """
        from bayescal._calibration.posterior_tree import build_tree  # and xarray with it

        return build_tree(self)

    def with_log_likelihood(self) -> xr.DataTree:
        """A copy of `tree` with the group `log_likelihood`, (chain, draw, reading), for `arviz_stats.loo` and its like.

        Made anew each time, since it is as large as draws times readings; above two million numbers draws are thinned,
        and those of the other groups with them. Under correlated noise a reading's is given those before it in its run.
        """
        from bayescal._calibration.posterior_tree import with_log_likelihood

        return with_log_likelihood(self.tree, self)

    def save(self, path: str | Path) -> Path:
        """Write draws, mode and readings to NetCDF, beside and then renamed. `bc.load` reads them back."""
        return save(self, Path(path))
