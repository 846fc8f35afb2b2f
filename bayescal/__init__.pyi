"""The public names, each listed once. `lazy_loader` reads this file when `bayescal` is imported."""

# the loop: read, fit, see where it fails, find what is missing, compare; all of it at once
from ._data.read import read as read
from ._calibration.fit import fit as fit
from ._calibration.fit import load as load
from ._calibration.predict import predict as predict
from ._calibration.check import check as check
from ._calibration.compare import compare as compare
from ._search.discover import discover as discover
from ._report.save_search import calibrate as calibrate
from ._report.save_search import calibrate_channels as calibrate_channels

# beside the loop: which test to run next, an effect's draft
from ._search.next_experiment import next_experiment as next_experiment
from ._search.undetermined import undetermined as undetermined
from ._search.draft_effect import draft_effect as draft_effect

# an instrument of one's own, tried on itself
from ._search.check_instrument import check_instrument as check_instrument
from ._search.check_instrument import InstrumentCheck as InstrumentCheck

# a sensor's noise, as data sheets give it
from ._calibration.sensor_noise import noise as noise
from ._calibration.sensor_noise import SensorNoise as SensorNoise
from ._data.set_aside import exclude_faults as exclude_faults
from ._data.allan_deviation import allan_deviation as allan_deviation
from ._data.allan_deviation import AllanDeviation as AllanDeviation

# what leaves: the compensation, its budget, pictures, the report for sign-off
from ._use.compensator import compensator as compensator
from ._annexes.imu.vector_series import vector_correction as vector_correction
from ._annexes.imu.still_stretches import poses as poses
from ._annexes.imu.moves import moves as moves
from ._annexes.imu.vector_files import export_vector as export_vector
from ._use.budget import budget as budget
from ._annexes.metrology.decide import decide as decide
from ._annexes.metrology.reference_dcc import read_dcc as read_dcc
from ._annexes.imu.firmware_parameters import firmware_parameters as firmware_parameters
from ._report.report import report as report
from . import plot as plot
from ._annexes.workbench.start import (
    workbench as workbench,
)  # in a notebook; needs bayescal[workbench]

# what a model is made of
from ._model.model import Instrument as Instrument  # with `baseline`, which model.py attaches
from ._model.instrument import Slot as Slot
from ._model.instrument import Use as Use
from ._model.vector import Vector as Vector
from ._model.model import Model as Model
from ._model.effect import Effect as Effect
from ._model.formula import effect as effect
from ._core.xp import xp as xp  # functions of arrays, for bases and responses
from ._model.effect import Coefficient as Coefficient
from ._model.effect import Shape as Shape
from ._model.frame import Frame as Frame
from ._data.column import Column as Column
from ._data.column import NominalScale as NominalScale
from ._data.measurements import Measurements as Measurements

# noise laws and priors
from ._model.noise_law import Noise as Noise
from ._model.noise_law import offered as offered
from ._model.independent_noise import White as White
from ._model.independent_noise import Heteroscedastic as Heteroscedastic
from ._model.summed_noise import OrnsteinUhlenbeck as OrnsteinUhlenbeck
from ._model.summed_noise import SummedNoise as SummedNoise
from ._model.independent_noise import StudentT as StudentT
from ._model.independent_noise import Quantised as Quantised
from ._model.prior import Flat as Flat
from ._model.prior import Normal as Normal
from ._model.prior import HalfNormal as HalfNormal
from ._model.prior import HalfCauchy as HalfCauchy
from ._model.prior import LogNormal as LogNormal

# methods of fitting
from ._inference.marginal import Marginal as Marginal
from ._inference.least_squares import LeastSquares as LeastSquares
from ._inference.non_centred import non_centred as non_centred
from ._inference.nuts import NUTS as NUTS
from ._inference.nuts import numpyro_program as numpyro_program

# results
from ._calibration.calibration import Calibration as Calibration
from ._core.settings import Settings as Settings
from ._core.settings import use_settings as use_settings
from ._inference.method import Verdict as Verdict
from ._calibration.check import Check as Check
from ._calibration.compare import Comparison as Comparison
from ._search.discover import Discovery as Discovery
from ._report.save_search import (
    SearchPath as SearchPath,
)  # with `save`, which save_search.py attaches
from ._report.save_search import Channels as Channels  # with `save`, which save_search.py attaches
from ._search.next_experiment import NextExperiment as NextExperiment
from ._search.undetermined import Undetermined as Undetermined
from ._use.compensator import Compensator as Compensator
from ._annexes.imu.vector_correction import VectorCorrection as VectorCorrection
from ._use.budget import Budget as Budget
from ._annexes.metrology.decide import Decisions as Decisions
from ._annexes.imu.firmware_parameters import FirmwareParameters as FirmwareParameters

# many devices at once
from ._annexes.fleet.fit_batch import fit_batch as fit_batch
from ._annexes.fleet.devices import split_devices as split_devices
from ._annexes.fleet.devices import Devices as Devices
from ._annexes.fleet.batch_result import BatchResult as BatchResult
from ._annexes.fleet.batch_result import load_batch as load_batch

# refusals
from ._core.errors import BayescalError as BayescalError
from ._core.errors import InputError as InputError
from ._core.errors import ModelError as ModelError
from ._core.errors import NotConverged as NotConverged
from ._core.errors import NotDrawn as NotDrawn

__version__: str
__all__: list[str]
