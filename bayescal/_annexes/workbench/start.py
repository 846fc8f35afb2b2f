"""Start of the workbench in a notebook; heavy modules, such as Panel, are imported on use."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bayescal as bc


def require_panel() -> None:
    """Raise InputError if Panel is not installed."""
    if importlib.util.find_spec("panel") is None:
        raise bc.InputError(
            "the workbench needs Panel, which is not installed: pip install 'bayescal[workbench]'"
        )


def workbench(
    readings: bc.Measurements,
    instrument: bc.Instrument | bc.Model,
    *,
    holdout: bc.Measurements | None = None,
    effects: Sequence[bc.Effect] = (),
    folder: str | Path | None = None,
    **settings: Any,
) -> Any:
    """Open the workbench in a notebook; for a browser, use the command `bayescal workbench`.

    Args:
        readings: readings to calibrate with.
        instrument: instrument whose baseline is the first model, or the first model.
        holdout, effects: as in `calibrate`.
        folder: folder to save the states in, by default a temporary one. A session in the folder is resumed.
        settings: options of `calibrate`: method, max_effects, widen_noise, keep_spikes, seed, reference, time_limit,
            accept_conflicts.

    Returns:
        A Panel view, shown if it is the last value of a cell.

    Raises:
        InputError: the folder cannot be written to, or Panel is not installed.
        ModelError: the readings lack a column that the model needs.
    """
    require_panel()
    import panel  # heavy, as are the imports below

    from bayescal._annexes.workbench.app import Workbench
    from bayescal._annexes.workbench.session import Session

    panel.extension(inline=True)
    is_model = isinstance(instrument, bc.Model)
    model = instrument if is_model else instrument.for_readings(readings).baseline()
    options = {"holdout": holdout, "effects": effects, "folder": folder, **settings}
    session = Session.open(model, readings, **options)
    return Workbench(session, is_embedded=True).view
