"""An electronic level whose zero drifts."""

from __future__ import annotations

import bayescal as bc
from bayescal import effects


def level(drift: float) -> bc.Instrument:
    """A level whose zero drifts; `drift` is the plausible size over the test, arcsec. Runs differ by some 0.5."""
    return bc.Instrument(
        name="level",
        title="an electronic level",
        columns=(bc.Column("time", "s"), bc.Column("run", None), bc.Column("output", "arcsec")),
        slots=(bc.Slot("zero", "arcsec"),),
        response=lambda slots, r: slots["zero"],
        effects=(
            effects.constant("zero", 100.0, "arcsec", source="made up"),
            effects.drift("zero", drift, "arcsec", source="made up"),
            effects.deviation("zero", "run", 0.5, "arcsec", source="made up"),
        ),
        noise=bc.White(bc.HalfCauchy(1.0)),
        use=bc.Use("tilt", "arcsec", equation=lambda tilt, slots, r: tilt + slots["zero"]),
    )
