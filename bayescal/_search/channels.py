"""The channels of one unit, calibrated together: a trail for each, and the shapes that they share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayescal._core.formatting import number, probability, with_error
from bayescal._core.result_table import Printed, ResultTable, plain_table
from bayescal._core.settings import settings
from bayescal._data.unit_conversion import unit_label
from bayescal._search.search_path import SearchPath
from bayescal._search.shared_shape import SharedShape

# Error of a new run over that of the readings as fitted, from which both are shown.
APART_RATIO = 1.1


@dataclass(frozen=True, repr=False)
class Channels(Printed):
    """What `calibrate_channels` gives.

    Attributes:
        trails: of each channel, by name: its models, errors, findings and last calibration.
        shared: what the channels say of each effect whose shape they share.
    """

    trails: Mapping[str, SearchPath]
    shared: tuple[SharedShape, ...]

    @property
    def ok(self) -> bool:
        """Whether every channel's result is reliable."""
        return all(trail.ok for trail in self.trails.values())

    if TYPE_CHECKING:

        def save(self, folder: Path) -> None:
            """Write all results to a folder; `save_search.py` attaches it."""

    @property
    def reason(self) -> str:
        """Why not, channel by channel; empty if all may be."""
        return " ".join(f"{n}: {t.gate.reason}" for n, t in self.trails.items() if not t.ok)

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects that some channel's last model holds, in the order of the models."""
        models = (t.final.calibration.model for t in self.trails.values())
        return tuple(dict.fromkeys(n for model in models for n in model.names))

    def _parts(self) -> list[str | ResultTable]:
        noise = ["noise", *(t.final.calibration.model.noise.law for t in self.trails.values())]
        rows = self._errors()
        for name in self.effects:
            sizes = (_size(trail, name) for trail in self.trails.values())
            cells = ("–" if mean is None else with_error(mean, sd) for mean, sd in sizes)
            rows.append([name, *cells])
        rows.append(noise)
        parts: list[str | ResultTable] = [plain_table(["", *self.trails], rows)]
        parts += [_shared_text(s) for s in self.shared if s.probability > 0.5]
        # Of a search that ended early; one that could not begin is not reliable, which is said.
        searches = {n: t.search for n, t in self.trails.items() if t.search is not None}
        parts += [f"{n}: {s.stopped}" for n, s in searches.items() if not s.complete]
        against = {n: t.gate.reason for n, t in self.trails.items() if not t.ok}
        return [*parts, *(f"{n}: result not reliable: {why}" for n, why in against.items())]

    def _brief(self) -> str:
        return f"{', '.join(self.trails)}; effects {', '.join(self.effects) or 'none'}"

    def _columns(self) -> dict[str, list[Any]]:
        """A row for each channel's last model: errors in its unit, mean sizes of effects in theirs."""
        finals = [trail.final for trail in self.trails.values()]
        return {
            "channel": list(self.trails),
            "unit": [s.calibration.unit for s in finals],
            "as fitted, first model": [t.steps[0].rmse_fitted for t in self.trails.values()],
            "as fitted, last": [s.rmse_fitted for s in finals],
            "new run, last": [s.rmse for s in finals],
            "held out": [s.holdout_rmse for s in finals],
            "noise floor": [s.noise_floor for s in finals],
            **{e: [_size(t, e)[0] for t in self.trails.values()] for e in self.effects},
            "noise": [s.calibration.model.noise.law for s in finals],
        }

    def _errors(self) -> list[list[str]]:
        trails, columns = self.trails.values(), self._columns()
        shown = ["as fitted, first model", "as fitted, last"]
        if any(t.final.rmse > APART_RATIO * t.final.rmse_fitted for t in trails):
            shown.append("new run, last")
        if any(t.holdout is not None for t in trails):
            shown += ["held out, first", "held out, last"]
            columns["held out, first"] = [t.steps[0].holdout_rmse for t in trails]
            columns["held out, last"] = columns["held out"]
        rows = [[name, *map(number, columns[name])] for name in (*shown, "noise floor")]
        return [["unit", *map(unit_label, columns["unit"])], *rows]


def _size(trail: SearchPath, name: str) -> tuple[float | None, float]:
    """Of an effect, and its uncertainty, as they leave; None where the channel's model lacks it."""
    model = trail.final.calibration.model
    if name not in model.names:
        return None, 0.0
    effect = model.effect(name)
    size = effect.measure_name or effect.coefficient_name(0)
    draws = trail.calibration.samples(size)
    return float(draws.mean()), float(draws.std())


def _shared_text(s: SharedShape) -> str:
    """One line on what the unit has."""
    middle, low, high = s.posterior
    showing = (
        ", ".join(n for n in s.says if s.evidence(n) > settings().strong_evidence) or "none alone"
    )
    unit = unit_label(s.shape.unit)
    return (
        f"{s.effect}: the unit has it with probability {probability(s.probability)}, {s.shape.name} "
        f"{number(middle)} {unit} (95 %: {number(low)} to {number(high)}), shown by {showing}"
    )
