"""The page `docs/still_logs.md`, of `still_logs.py`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayescal._core.formatting import number
from benchmarks.markdown import table
from benchmarks.real_records.still_log_sources import StillLog
from benchmarks.record import DOCS

HEAD = """\
# Still logs of others

Rendered by `python -m benchmarks still_logs` from `benchmarks/results/`.

Public logs of instruments at rest that others have recorded, each told by [`bayescal noise`](noise.md) and nothing
else. The noise of the first half foretells the second: *inside* counts the averaging times at which the Allan deviation
of the second half lies in the band of 95 % of such records under the noise of the first half. Neighbouring averaging
times share their readings, so their deviations leave the band together. A channel that is listed as a source and has no
row was not measured yet.

The logs are not part of bayescal. Where they come from, and under which licence:

"""


def write(logs: Sequence[StillLog], channels: Mapping[str, Any]) -> None:
    """The page."""
    parts = [HEAD, *map(_source, logs), "\n"]
    rows, shown = [], []
    for log in logs:
        found = {
            c: channels[f"{log.file}: {c}"] for c in log.channels if f"{log.file}: {c}" in channels
        }
        rows += [_row(log, channel, one) for channel, one in found.items()]
        if found:
            shown.append(_whole(log, *next(iter(found.items()))))
    head = ("log", "channel", "readings", "law of the first half", "inside", "outside at τ [s]")
    text = "".join([*parts, "## The second half\n\n", table(head, rows), *shown])
    (DOCS / "still_logs.md").write_text(text, encoding="utf-8")


def _source(log: StillLog) -> str:
    return (
        f"- **{log.title}**: [`{log.path}`]({log.source}/blob/{log.commit}/{log.path}), commit `{log.commit[:12]}`. "
        f"Licence: {log.licence}. {log.made}.\n"
    )


def _row(log: StillLog, channel: str, one: Mapping[str, Any]) -> list[str]:
    inside, tau = one["inside"], one["tau"]
    outside = ", ".join(number(t) for t, there in zip(tau, inside, strict=True) if not there)
    return [
        log.file,
        channel,
        f"{one['readings']:,}",
        one["first_half"],
        f"{sum(inside)} of {len(inside)}",
        outside or "none",
    ]


def _whole(log: StillLog, channel: str, one: Mapping[str, Any]) -> str:
    """What the command prints of a whole channel, and the file for a filter."""
    command = f"bayescal noise {log.file} --columns output={channel}"
    command += " --yaml imu.yaml" if one["yaml"] else ""
    said = f"\n## {log.title}\n\n```console\n$ {command}\n{one['printed']}\n```\n"
    return said + (f"\n```yaml\n{one['yaml']}```\n" if one["yaml"] else "")
