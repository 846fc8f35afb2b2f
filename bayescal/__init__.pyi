"""The public names, each listed once. `lazy_loader` reads this file when `bayescal` is imported."""

# the loop: read, fit, see where it fails, find what is missing, compare, all of it at once
# what a model is made of
from . import effects as effects
from . import plot as plot

# results
from ._calibration.calibration import Calibration as Calibration
from ._calibration.fit import fit as fit
from ._calibration.fit import load as load
from ._calibration.predict import predict as predict
from ._compensation.budget import Budget as Budget
from ._compensation.budget import budget as budget
from ._compensation.compensator import Compensator as Compensator

# what leaves: the compensation, its budget, pictures, the report to sign
from ._compensation.compensator import compensator as compensator
from ._compensation.compensator import load_compensator as load_compensator

# refusals
from ._core.errors import BayescalError as BayescalError
from ._core.errors import InputError as InputError
from ._core.errors import ModelError as ModelError
from ._core.errors import NotConverged as NotConverged
from ._diagnostics.check import Check as Check
from ._diagnostics.check import check as check
from ._diagnostics.compare import Comparison as Comparison
from ._diagnostics.compare import compare as compare
from ._discovery.calibrate import calibrate as calibrate
from ._discovery.discover import Discovery as Discovery
from ._discovery.discover import discover as discover
from ._discovery.draft_effect import shape_of as shape_of
from ._discovery.draft_effect import template as template
from ._discovery.false_reports import FalseReports as FalseReports
from ._discovery.false_reports import false_reports as false_reports
from ._discovery.next_experiment import NextExperiment as NextExperiment

# beside the loop: which test to run next, how often a search reports what is not there, an effect's draft
from ._discovery.next_experiment import next_experiment as next_experiment
from ._discovery.search_path import Trail as Trail
from ._fleet.batch_result import BatchResult as BatchResult
from ._fleet.batch_result import load_batch as load_batch
from ._fleet.devices import Devices as Devices

# many devices at once
from ._fleet.fit_batch import fit_batch as fit_batch
from ._fleet.split_devices import split_devices as split_devices
from ._fleet.weighted_draws import Batch as Batch
from ._fleet.weighted_draws import weighted_draws as weighted_draws
from ._inference.least_squares import LeastSquares as LeastSquares

# methods of fitting
from ._inference.marginal import Marginal as Marginal
from ._inference.method import Verdict as Verdict
from ._inference.nuts import NUTS as NUTS
from ._model.coefficient import Coefficient as Coefficient
from ._model.coefficient import Shape as Shape
from ._model.effect import Effect as Effect
from ._model.frame import Frame as Frame
from ._model.instrument import Instrument as Instrument
from ._model.instrument import Slot as Slot
from ._model.instrument import Use as Use
from ._model.model import Model as Model

# noise laws and priors
from ._model.noise import Noise as Noise
from ._model.noise import OrnsteinUhlenbeck as OrnsteinUhlenbeck
from ._model.noise import Quantised as Quantised
from ._model.noise import StudentT as StudentT
from ._model.noise import White as White
from ._model.prior import Flat as Flat
from ._model.prior import HalfCauchy as HalfCauchy
from ._model.prior import HalfNormal as HalfNormal
from ._model.prior import Normal as Normal
from ._numpyro.program_fit import ProgramFit as ProgramFit
from ._readings.measurements import Column as Column
from ._readings.measurements import Measurements as Measurements
from ._readings.measurements import NominalScale as NominalScale
from ._readings.read import read as read
from ._report.report import report as report

__version__: str
__all__: list[str]
