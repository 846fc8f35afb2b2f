"""bayescal: Bayesian calibration of inertial and tilt sensors.

Read readings, compose a model, fit it, see where it fails, find the effect that is missing, add it:

    import bayescal as bc
    from bayescal_models import mems_gyro

    readings = bc.read("table.csv", mems_gyro.INSTRUMENT)
    calibration = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings)
    found = bc.discover(calibration)

The names below load on first use, so that `import bayescal` and `bayescal --help` cost nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bayescal import _startup as _startup  # before JAX: see the comment there

if TYPE_CHECKING:
    # pictures, and the report to sign
    from bayescal import _plot as plot
    from bayescal._report import report as report

    # what did it find, and was it right
    from bayescal._budget import Budget as Budget
    from bayescal._budget import budget as budget
    from bayescal._calibrate import calibrate as calibrate
    from bayescal._calibration import Calibration as Calibration
    from bayescal._calibration import Verdict as Verdict
    from bayescal._check import Check as Check
    from bayescal._check import check as check

    from bayescal._trail import Trail as Trail

    # what a model is made of
    from bayescal._coefficient import Coefficient as Coefficient
    from bayescal._coefficient import Shape as Shape
    from bayescal._compare import Comparison as Comparison
    from bayescal._compare import compare as compare
    from bayescal._compensate import Compensator as Compensator
    from bayescal._compensate import compensator as compensator
    from bayescal._compensate import load_compensator as load_compensator
    from bayescal._discover import Discovery as Discovery
    from bayescal._discover import discover as discover
    from bayescal._effect import Effect as Effect
    from bayescal._experiment import NextExperiment as NextExperiment
    from bayescal._screen import FalseReports as FalseReports
    from bayescal._screen import false_reports as false_reports
    from bayescal._experiment import next_experiment as next_experiment
    from bayescal._errors import BayescalError as BayescalError
    from bayescal._errors import InputError as InputError
    from bayescal._errors import ModelError as ModelError
    from bayescal._errors import NotConverged as NotConverged

    # fits
    from bayescal._fit import fit as fit
    from bayescal._fit import load as load
    from bayescal._program import ProgramFit as ProgramFit

    # many devices at once
    from bayescal._batch import fit_batch as fit_batch
    from bayescal._batch_devices import Devices as Devices
    from bayescal._batch_split import split_devices as split_devices
    from bayescal._batch_draws import Batch as Batch
    from bayescal._batch_draws import weighted_draws as weighted_draws
    from bayescal._batch_result import BatchResult as BatchResult
    from bayescal._batch_result import load_batch as load_batch

    # and what they need
    from bayescal._frame import Frame as Frame
    from bayescal._instrument import Instrument as Instrument
    from bayescal._instrument import Slot as Slot
    from bayescal._instrument import Use as Use
    from bayescal._least_squares import LeastSquares as LeastSquares
    from bayescal._marginal import Marginal as Marginal
    from bayescal._measurements import Column as Column
    from bayescal._measurements import Measurements as Measurements
    from bayescal._measurements import NominalScale as NominalScale
    from bayescal._model import Model as Model
    from bayescal._noise import Noise as Noise
    from bayescal._noise import OrnsteinUhlenbeck as OrnsteinUhlenbeck
    from bayescal._noise import Quantised as Quantised
    from bayescal._noise import StudentT as StudentT
    from bayescal._noise import White as White
    from bayescal._nuts import NUTS as NUTS
    from bayescal._predict import predict as predict
    from bayescal._prior import Flat as Flat
    from bayescal._prior import HalfCauchy as HalfCauchy
    from bayescal._prior import HalfNormal as HalfNormal
    from bayescal._prior import Normal as Normal
    from bayescal._read import read as read
    from bayescal._template import shape_of as shape_of
    from bayescal._template import template as template

_HOMES = {
    "BayescalError": "_errors",
    "Batch": "_batch_draws",
    "BatchResult": "_batch_result",
    "Budget": "_budget",
    "Calibration": "_calibration",
    "Check": "_check",
    "Coefficient": "_coefficient",
    "Column": "_measurements",
    "Comparison": "_compare",
    "Compensator": "_compensate",
    "Devices": "_batch_devices",
    "Discovery": "_discover",
    "Effect": "_effect",
    "Flat": "_prior",
    "Frame": "_frame",
    "HalfCauchy": "_prior",
    "HalfNormal": "_prior",
    "InputError": "_errors",
    "Instrument": "_instrument",
    "LeastSquares": "_least_squares",
    "Marginal": "_marginal",
    "Measurements": "_measurements",
    "Model": "_model",
    "ModelError": "_errors",
    "NUTS": "_nuts",
    "NextExperiment": "_experiment",
    "FalseReports": "_screen",
    "Noise": "_noise",
    "OrnsteinUhlenbeck": "_noise",
    "NominalScale": "_measurements",
    "Normal": "_prior",
    "NotConverged": "_errors",
    "ProgramFit": "_program",
    "Quantised": "_noise",
    "Shape": "_coefficient",
    "Slot": "_instrument",
    "StudentT": "_noise",
    "Trail": "_trail",
    "Use": "_instrument",
    "Verdict": "_calibration",
    "White": "_noise",
    "budget": "_budget",
    "calibrate": "_calibrate",
    "check": "_check",
    "compare": "_compare",
    "compensator": "_compensate",
    "discover": "_discover",
    "fit": "_fit",
    "fit_batch": "_batch",
    "load": "_fit",
    "load_batch": "_batch_result",
    "next_experiment": "_experiment",
    "false_reports": "_screen",
    "load_compensator": "_compensate",
    "plot": "_plot",
    "predict": "_predict",
    "read": "_read",
    "report": "_report",
    "shape_of": "_template",
    "split_devices": "_batch_split",
    "template": "_template",
    "weighted_draws": "_batch_draws",
}

__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Load a public name from its home module on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'bayescal' has no public name {name!r}")
    from importlib import import_module

    module = import_module(f"bayescal.{_HOMES[name]}")
    value = module if name == "plot" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
