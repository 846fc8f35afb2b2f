"""What tests ask of the inside that has no public way out, each in one place: a redesign changes this file alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._annexes.fleet.batch_result import DeviceResult as DeviceResult
from bayescal._annexes.fleet.find_devices import DeviceStructure as DeviceStructure
from bayescal._annexes.fleet.find_devices import estimate_shares as estimate_shares
from bayescal._annexes.fleet.find_devices import find_favoured_effects as find_favoured_effects
from bayescal._annexes.imu.imu_annex import Triad as Triad
from bayescal._annexes.imu.still_stretches import find_static_segments as find_static_segments
from bayescal._annexes.metrology.certificate import Certificate, generate_dcc
from bayescal._annexes.metrology.certificate import find_d_si as find_d_si
from bayescal._annexes.metrology.conformity import DrawnQuantity as DrawnQuantity
from bayescal._annexes.metrology.conformity import Limits as Limits
from bayescal._annexes.metrology.conformity import compute_global_risks as compute_global_risks
from bayescal._annexes.metrology.conformity import find_acceptance as find_acceptance
from bayescal._annexes.validation import nist_strd as nist_strd
from bayescal._annexes.validation import validation_record as validation_record
from bayescal._annexes.workbench.session import Session as Session
from bayescal._annexes.workbench.session_store import Origin as Origin
from bayescal._calibration.check import autocorrelation as autocorrelation
from bayescal._calibration.claim import CRITERIA as CRITERIA
from bayescal._calibration.claim import Claim as Claim
from bayescal._calibration.claim import as_claim as as_claim
from bayescal._core.formatting import format_interval as format_interval
from bayescal._core.importance_weights import smooth as smooth
from bayescal._core.json_data import validate as validate
from bayescal._core.quoting import to_identifier as to_identifier
from bayescal._data.allan_deviation import EvenRuns as EvenRuns
from bayescal._data.allan_deviation import allan_variances as allan_variances
from bayescal._data.allan_deviation import compute_edf as compute_edf
from bayescal._data.column import find_overloads
from bayescal._data.set_aside import flag_fitted_holdout
from bayescal._data.unit_conversion import coefficient_factor as coefficient_factor
from bayescal._data.unit_conversion import format_unit as format_unit
from bayescal._inference.noise_on_record import Whitening as Whitening
from bayescal._inference.record import Record as Record
from bayescal._model import forward as forward
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.model import why_untestable as why_untestable
from bayescal._model.noise_law import Parameters as Parameters
from bayescal._model.summed_noise import build_sum as build_sum
from bayescal._model.vector import compute_radial_residual as compute_radial_residual
from bayescal._model.vector import invert_equation as invert_equation
from bayescal._report.result_json import result
from bayescal._report.whole_folder import refuse_mixed as refuse_mixed
from bayescal._search.next_experiment import CampaignPrediction as CampaignPrediction
from bayescal._search.next_experiment import compute_divergence as compute_divergence
from bayescal._search.noise_laws import fit_to_residuals as fit_to_residuals
from bayescal._search.replaced_terms import find_replaced_terms as find_replaced_terms
from bayescal._tables.mapping_file import load_mapping as load_mapping
from bayescal._tables.mapping_file import save_mapping as save_mapping
from bayescal._tables.raw_table import to_one_line as to_one_line
from bayescal._use.compensate_file import compensate_file as compensate_file
from bayescal._use.compensation_program import CompensationProgram as CompensationProgram
from bayescal.workshop import MANIFEST as MANIFEST
from bayescal.workshop import ReadOptions, as_json, as_text, identity, write_json
from bayescal.workshop import format_value as format_value
from bayescal.workshop import read_hashes as read_hashes
from bayescal.workshop import replace_folder as replace_folder

identity_of = identity  # SHA-256 by which every artefact names a calibration
result_of = result  # what `save` of a search writes as result.json, nothing drawn
text_of = as_text  # an export as text, no file written
said_of_holdout = flag_fitted_holdout  # what is said of hold-out data that are not new


def constants_of(readings: bc.Measurements) -> dict[str, Any]:
    """Constants of the bases of readings, such as T0."""
    return dict(reference_of(readings))


def frame_of(readings: bc.Measurements, constants: Mapping[str, Any] | None = None) -> bc.Frame:
    """What bases are evaluated over: readings, with their own constants or others."""
    return build_frame(readings, reference_of(readings) if constants is None else constants)


def screen_of(path: bc.SearchPath, verbose: bool = False) -> str:
    """What `bayescal calibrate` prints of a search."""
    from bayescal._cli.output import format_loop

    return format_loop(path, verbose=verbose)


def dcc_of(calibration: bc.Calibration, stated: Any, decided: bc.Decisions | None = None) -> str:
    """The digital calibration certificate as XML; `stated`: its file, or what stands in it."""
    given = Certificate(stated) if isinstance(stated, dict) else stated
    return generate_dcc(calibration, given, decisions=decided)


def is_overload(value: float) -> bool:
    """Whether a number stands for an overload of a voltmeter, as 9.9e37 does."""
    return bool(find_overloads(np.array([value])).size)


def nominal_scale_of(instrument: bc.Instrument, said: str) -> bc.NominalScale | None:
    """A nominal scale as it is said on the command line."""
    return ReadOptions.of(instrument, nominal_scale=said).nominal_scale


def write_plain_json(data: Any, path: Path) -> None:
    """Write data as every JSON of bayescal is written: numbers that are not finite as null."""
    write_json(as_json(data), path)


# Readings that a task of a batch takes: some five devices.
SMALL_TASKS = ("bayescal._annexes.fleet.fit_batch.MAX_READINGS_PER_FIT_TASK", 100)


def cluster_of(workers: int) -> Any:
    """A Dask cluster as `bayescal batch --workers` opens one, for the length of a block."""
    from bayescal._annexes.fleet.engine import open_cluster

    return open_cluster(workers)


def page_of(session: Session) -> Any:
    """The workbench's page over a session, as Panel shows it."""
    from bayescal._annexes.workbench.app import Workbench

    return Workbench(session).view
