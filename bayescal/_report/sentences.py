"""The sentences of a report: how the model came about, what it may be used for and where not, what is left open."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from bayescal._calibration.settings import searching
from bayescal._core.formatting import probability
from bayescal._data.unit_conversion import unit_label
from bayescal._report.conclusion import conclusion, listed, not_tested
from bayescal._report.plot_search import is_quiet
from bayescal._report.section import Chapter
from bayescal._report.tables import READ, UNUSED, measured, ranges

ABOVE_NOISE = 1.1  # rms error over the noise floor from which something is left to explain


def use_and_limits(chapter: Chapter) -> tuple[list[str], list[str]]:
    """What the calibration may be used for, and where not, a sentence each."""
    c = chapter.calibration
    instrument = c.model.instrument
    rows = ranges(c)
    if not ok(chapter):
        return [], ["For nothing until what stands against it is settled: see the verdict."]
    covered = [
        f"{r['name']} {r['low']} to {r['high']} {r['unit']}".strip()
        for r in rows
        if not r["constant"] and r["part"] not in (READ, UNUSED) and r["name"] not in ("time",)
    ]
    what = (
        f"turning a reading of the output into {instrument.use.stimulus} [{unit_label(instrument.use.unit) or '1'}]"
        if instrument.use is not None
        else "predicting the output"
    )
    may = [f"{what[0].upper()}{what[1:]}, by the model of this report."]
    if covered:
        may.append("Within what was covered: " + "; ".join(covered) + ".")
    return may, _limits(chapter, rows)


def _limits(chapter: Chapter, rows: list[dict[str, Any]]) -> list[str]:
    use = chapter.calibration.model.instrument.use
    not_for = [
        "Outside these ranges: nothing was measured there, and nothing warns but the compensator."
    ]
    for r in rows:
        if r["constant"] and r["name"] != "output" and (use is None or r["name"] != use.stimulus):
            at = f"{r['low']} {r['unit']}".strip()
            not_for.append(
                f"Under another {r['name']} than {at}, at which all readings were taken."
            )
    if (
        use is not None
        and use.equation is None
        and use.stimulus not in {r["name"] for r in rows if not r["constant"]}
    ):
        not_for.append(
            f"To tell how the output follows {use.stimulus}: it was not varied, so the model's own equation stands "
            "untested."
        )
    last = last_discovery(chapter)
    candidates = last["candidates"] if last else []
    blind = [c["effect"] for c in candidates if c["kind"] == "not visible" and not is_quiet(c)]
    not_for += [
        f"Where {listed(names, 'or')} matters: it was not tested ({reason})."
        for reason, names in not_tested(candidates).items()
    ]
    if blind:
        not_for.append(
            f"Where {listed(blind, 'or')} matters: it is not detectable in this experiment."
        )
    new = [r["name"] for r in chapter.data["hyperparameters"] if r["name"].endswith(".group_sd")]
    if new:
        not_for.append(
            f"By its coefficients' uncertainties alone: a new member of a group brings a deviation of its own "
            f"({', '.join(new)}). The uncertainty budget and compensated readings contain it."
        )
    return not_for


def last_discovery(chapter: Chapter) -> dict[str, Any] | None:
    """What was missing from the last model; None where that was not asked."""
    last = len(chapter.data["steps"]) - 1
    return next((m for m in chapter.data["missing"] if m["step"] == last), None)


def ok(chapter: Chapter) -> bool:
    return bool(chapter.data["verdict"]["ok"])


def unexplained(chapter: Chapter) -> list[str]:
    """What the last model leaves open, a sentence each."""
    step, unit = chapter.data["steps"][-1], chapter.calibration.unit
    rms, new, noise = step["rmse_fitted"], step["rmse"], step["noise_floor"]
    said = [
        f"rms error as fitted {measured(rms, unit, 3)} against a noise floor of {measured(noise, unit, 3)}: "
        + (
            f"about {measured((rms**2 - noise**2) ** 0.5, unit, 2)} rms is more than noise."
            if rms > ABOVE_NOISE * noise
            else "nothing beyond the noise."
        )
    ]
    if new > ABOVE_NOISE * rms:
        said.append(
            f"A new run has an rms error of {measured(new, unit, 3)}: it brings a deviation of its own."
        )
    if step["holdout_rmse"] is not None:
        first = chapter.data["steps"][0]["holdout_rmse"]
        said.append(
            f"Readings that no fit saw are predicted with an rms error of {measured(step['holdout_rmse'], unit, 3)} "
            f"(first model: {measured(first, unit, 3)})."
        )
    for e in chapter.check.entries:
        if e.log_bayes_factor > searching().strong:
            size = f"{e.worst.size:+.2g} {unit_label(unit)}".replace("-", "−")
            said.append(
                f"The residuals still depend on {e.against} (up to {size}; log Bayes factor {e.log_bayes_factor:.1f})."
            )
    last = last_discovery(chapter)
    if last is None:
        said.append("What is missing was not asked: the last fit did not converge.")
    else:
        said.append(
            "Probability that the model is complete, that is, that no candidate that these readings can show is "
            f"missing: {last.get('unstated') or probability(last['nothing_missing_probability'])}."
        )
        for kind in ("finding", "lead"):
            names = [c["effect"] for c in last["candidates"] if c["kind"] == kind]
            if names:
                said.append(f"{kind.capitalize()}, not in the model: {listed(names, 'or')}.")
    if chapter.check.outliers:
        said.append(
            f"{len(chapter.check.outliers)} outlying readings (more than 4 standard deviations)."
        )
    if chapter.data["other_path"] is not None:
        said.append(chapter.data["other_path"]["in_words"])
    if why := (chapter.data.get("search") or {}).get("ending"):
        said.append(why)
    if not chapter.data["gate"]["ok"]:
        said.append(chapter.data["gate"]["reason"])
    return said


def story(chapter: Chapter) -> list[str]:
    """The result in one paragraph, and how the last model came about, a sentence each step."""
    steps, unit = chapter.data["steps"], chapter.calibration.unit
    findings = {
        m["step"]: {n for s in m["sets"] for n in s["effects"]} for m in chapter.data["missing"]
    }
    said = [
        conclusion(chapter),
        f"It began with {steps[0]['title']}: rms error as fitted {measured(steps[0]['rmse_fitted'], unit, 3)}.",
    ]
    for i, (before, step) in enumerate(pairwise(steps)):
        name = step["added"]
        if name and name in findings.get(i, ()):
            what = f"{name} was found missing. Added, it"
        else:
            what = f"Adding {name}" if name else f"The step «{step['title']}»"
        errors = (measured(s["rmse_fitted"], unit, 3) for s in (before, step))
        said.append(f"{what} brought the rms error as fitted from {' to '.join(errors)}.")
    return said
