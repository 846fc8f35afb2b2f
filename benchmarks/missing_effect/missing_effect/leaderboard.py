"""The leaderboard: a table of entries as text, and as a self-contained HTML page."""

from __future__ import annotations

import math
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from missing_effect.edition import TRACKS
from missing_effect.score import CLEAR, Score, Summary, by_track, calibration, summary

HEADS = {
    "log": "log score",
    "log_exact": "of the exact set",
    "brier": "Brier",
    "alarm": "false alarms (0.95)",
    "likely_alarm": "false alarms (0.5)",
    "crps": "CRPS / σ",
    "covered": "coverage of 95 %",
    "seconds": "CPU s a task",
}
SHARES = ("alarm", "likely_alarm", "covered")
STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;margin:1rem 0}td,th{padding:.3rem .7rem;border-bottom:1px solid #ccc;text-align:right}
td:first-child,th:first-child{text-align:left}small{color:#666}tr.first td{font-weight:600}
@media(prefers-color-scheme:dark){body{background:#161616;color:#ddd}td,th{border-color:#444}small{color:#999}}"""

Entries = dict[str, dict[str, Score]]


def order(entries: Entries) -> list[tuple[str, Summary]]:
    """Return the entries by log score, the best first, then those without sets, by their prediction."""
    all_ = [(name, summary(scores)) for name, scores in entries.items()]
    return sorted(
        all_, key=lambda e: (math.isnan(e[1].log[0]), -_or_zero(e[1].log[0]), e[1].crps[0])
    )


def tables(entries: Entries) -> dict[str, list[list[str]]]:
    """Return the leaderboard's tables by heading: rows of cells, headers first."""
    ranked = order(entries)
    means = [["entry", *HEADS.values(), "no answer"]]
    for name, s in ranked:
        cells = [_cell(getattr(s, key), key in SHARES) for key in HEADS]
        means.append([name, *cells, str(sum(bool(e.failed) for e in entries[name].values()))])
    tracks = [
        t
        for t in (*TRACKS, "real")
        if any(t == s.track for e in entries.values() for s in e.values())
    ]
    logs, crps = [["entry", *tracks, "all but fleets", "fleets"]], [["entry", *tracks]]
    bands = [["entry", "band", "tasks", "mean stated", "share true (95 % interval)"]]
    for name, s in ranked:
        if not math.isnan(s.log[0]):
            averages = by_track(entries[name], lambda e: e.log)
            scores = [(e.fleet, e.log) for e in entries[name].values() if e.log is not None]
            parts = ([log for fleet, log in scores if fleet is which] for which in (False, True))
            both = (float(np.mean(p)) if p else None for p in parts)
            logs.append([name, *(_plain(v) for v in (*map(averages.get, tracks), *both))])
            bands += [[name, *row] for row in _bands(calibration(entries[name]))]
        averages = by_track(entries[name], lambda e: e.crps)
        crps.append([name, *(_plain(averages.get(t)) for t in tracks)])
    return {
        f"Means over {len(next(iter(entries.values())))} tasks, with 95 % bootstrap intervals": means,
        "Log score by track": logs,
        "CRPS of the hold-out by track, in standard deviations of its noise": crps,
        "Calibration of the most probable set": bands,
        f"Tasks whose truth the readings decide (log Bayes factor above {CLEAR:g})": _clear(
            entries
        ),
    }


def markdown(entries: Entries, level: str = "##") -> str:
    """Return the tables as Markdown."""
    parts = []
    for head, rows in tables(entries).items():
        lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
        parts.append(f"{level} {head}\n\n" + "\n".join(f"| {' | '.join(r)} |" for r in lines))
    return "\n\n".join(parts) + "\n"


def page(entries: Entries, note: str) -> str:
    """Return the tables as an HTML page."""
    parts = [f"<h1>Find the missing effect</h1><p>{escape(note)}</p>"]
    for head, rows in tables(entries).items():
        body = "".join(
            f"<tr>{''.join(f'<td>{escape(c)}</td>' for c in row)}</tr>" for row in rows[1:]
        )
        heads = "".join(f"<th>{escape(c)}</th>" for c in rows[0])
        parts.append(f"<h2>{escape(head)}</h2><table><tr>{heads}</tr>{body}</table>")
    title = "<title>Find the missing effect</title>"
    meta = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    return (
        f"<!doctype html><html lang=en>{meta}{title}<style>{STYLE}</style>{''.join(parts)}</html>\n"
    )


def _clear(entries: Entries) -> list[list[str]]:
    """Return each track's number of clear tasks, and their mean log score."""
    scores = next(iter(entries.values()))
    tracks = [t for t in TRACKS if t != "empty" and any(t == s.track for s in scores.values())]
    shares = by_track(scores, lambda s: s.clear)
    rows = [
        ["", *tracks],
        ["share of tasks", *(f"{shares[t]:.0%}".replace("%", " %") for t in tracks)],
    ]
    for name, s in order(entries):
        if not math.isnan(s.log[0]):
            means = by_track(entries[name], lambda e: e.log if e.clear else None)
            rows.append([f"log score of {name}", *(_plain(means.get(t)) for t in tracks)])
    return rows


def _bands(rows: list[dict[str, Any]]) -> list[list[str]]:
    band_rows = []
    for r in rows:
        (low, high), (begin, end) = r["band"], r["interval"]
        share = f"{r['true']:.2f} ({begin:.2f} to {end:.2f})"
        outside = "" if begin <= r["stated"] <= end else " ✗"
        band_rows.append(
            [f"{low:g} to {high:g}", str(r["count"]), f"{r['stated']:.3f}", share + outside]
        )
    return band_rows


def _cell(value: tuple[float, float, float], share: bool) -> str:
    if math.isnan(value[0]):
        return "–"
    if share:
        mean, low, high = (100 * v for v in value)
        return f"{mean:.1f} % ({low:.1f} to {high:.1f})"
    digits = 3 if abs(value[0]) < 10 else 1
    mean, low, high = (f"{v + 0.0:.{digits}f}" for v in value)
    return f"{mean} ({low} to {high})"


def _plain(value: float | None) -> str:
    return "–" if value is None else f"{value + 0.0:.2f}"


def _or_zero(value: float) -> float:
    return 0.0 if np.isnan(value) else value


def write(entries: Entries, file: Path, note: str) -> None:
    """Write the page."""
    file.write_text(page(entries, note), "utf-8")
