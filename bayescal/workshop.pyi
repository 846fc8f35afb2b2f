"""The names of the workshop, each listed once. `lazy_loader` reads this file when `bayescal.workshop` is imported."""

# an annex, and what it may offer
# a calibration: its identity, its files, what stands against it; its part of a report
# what is said of a calibration
from ._calibration.check import collect_covariates as collect_covariates
from ._calibration.check import describe_region as describe_region
from ._calibration.check import why_not as why_not
from ._calibration.claim import Claim as Claim
from ._calibration.judgement import explain_missing_noise as explain_missing_noise
from ._calibration.prior_influence import find_prior_dominance as find_prior_dominance
from ._calibration.prior_influence import (
    find_prior_dominated_coefficients as find_prior_dominated_coefficients,
)
from ._calibration.storage import identity as identity
from ._calibration.storage import list_sources as list_sources
from ._calibration.summary import format_rows as format_rows
from ._calibration.summary import null_directions as null_directions
from ._calibration.summary import summary as summary
from ._cli.commands import ExportCommand as ExportCommand

# commands: their options, what they are asked for, what they answer
from ._cli.options import Answer as Answer
from ._cli.options import AsJson as AsJson
from ._cli.options import ColumnOptions as ColumnOptions
from ._cli.options import Command as Command
from ._cli.options import DecisionRule as DecisionRule
from ._cli.options import MemberOptions as MemberOptions
from ._cli.options import MethodName as MethodName
from ._cli.options import ModelOptions as ModelOptions
from ._cli.options import Options as Options
from ._cli.options import ReadRequest as ReadRequest
from ._cli.options import SearchRequest as SearchRequest
from ._cli.options import Shared as Shared
from ._cli.options import check_files_exist as check_files_exist
from ._cli.options import draw_safely as draw_safely
from ._cli.options import opt as opt
from ._cli.options import parse_numbers as parse_numbers
from ._cli.options import parse_pairs as parse_pairs
from ._cli.options import split_names as split_names
from ._cli.output import format_coefficients as format_coefficients
from ._cli.request import CALIBRATION as CALIBRATION
from ._cli.request import compose as compose
from ._cli.request import create_method as create_method
from ._cli.request import describe_reliability as describe_reliability
from ._cli.request import expand_channels as expand_channels
from ._cli.request import instrument_named as instrument_named
from ._cli.request import load_compensator as load_compensator
from ._cli.request import load_effects as load_effects
from ._cli.request import load_saved as load_saved
from ._cli.request import open_request as open_request
from ._cli.request import open_search as open_search

# modules whose names are a vocabulary: when work ends, colours
from ._core import deadline as deadline
from ._core.atomic_file import compute_sha256 as compute_sha256
from ._core.atomic_file import create_result_folder as create_result_folder

# files: written whole or not at all; folders of results
from ._core.atomic_file import replace_user_file as replace_user_file
from ._core.atomic_file import write_text as write_text
from ._core.formatting import format_value as format_value
from ._core.formatting import number as number
from ._core.formatting import probability as probability

# text for people and for programs: numbers, names, tables
from ._core.formatting import wrap as wrap
from ._core.inverse import iterate_newton as iterate_newton
from ._core.jit import compile_lazily as compile_lazily

# JSON, and the type that it must have
from ._core.json_data import as_json as as_json
from ._core.json_data import parse_json as parse_json
from ._core.json_data import read_json as read_json
from ._core.json_data import read_toml as read_toml
from ._core.json_data import write_json as write_json
from ._core.lazy_jax import ignore_local_configuration as ignore_local_configuration
from ._core.parallel import run_on_one_thread as run_on_one_thread
from ._core.progress import notify as notify
from ._core.progress import print_notes as print_notes
from ._core.progress import track as track
from ._core.quoting import escape_html as escape_html
from ._core.quoting import load_template as load_template
from ._core.quoting import quote_c_comment as quote_c_comment
from ._core.quoting import quote_python_comment as quote_python_comment
from ._core.quoting import to_ascii as to_ascii
from ._core.quoting import to_printable as to_printable
from ._core.renamed import renamed as renamed
from ._core.result_table import Printed as Printed
from ._core.result_table import ResultTable as ResultTable
from ._core.result_table import TableColumn as TableColumn
from ._core.result_table import make_table as make_table

# settings of a process
from ._core.settings import list_changed_settings as list_changed_settings
from ._core.settings import settings as settings
from ._core.settings import to_seed as to_seed

# files of readings
from ._data.column import UNCERTAINTY as UNCERTAINTY
from ._data.column import Place as Place
from ._data.column import Source as Source
from ._data.column_conversion import convert_columns as convert_columns
from ._data.dataset_checks import find_single_temperature as find_single_temperature
from ._data.dataset_checks import find_time_reversals as find_time_reversals
from ._data.header_matching import MatchedFile as MatchedFile
from ._data.header_matching import ReadOptions as ReadOptions
from ._data.header_matching import expected_columns as expected_columns
from ._data.pose_rows import ACROSS as ACROSS
from ._data.pose_rows import AXES as AXES
from ._data.pose_rows import AXIS as AXIS
from ._data.pose_rows import DIRECTION as DIRECTION
from ._data.pose_rows import MAGNITUDE as MAGNITUDE
from ._data.pose_rows import MAGNITUDE_READ as MAGNITUDE_READ
from ._data.pose_rows import RATE as RATE
from ._data.pose_rows import TURNED as TURNED
from ._data.pose_rows import fit_ellipsoid as fit_ellipsoid
from ._data.pose_rows import magnitude as magnitude
from ._data.read_options import ExpectedColumns as ExpectedColumns
from ._data.read_options import check_options as check_options
from ._data.read_options import output_name as output_name
from ._data.read_options import unit_of as unit_of
from ._data.records import equal_runs as equal_runs

# units
from ._data.unit_conversion import STANDARD_GRAVITY as STANDARD_GRAVITY
from ._data.unit_conversion import base_unit as base_unit
from ._data.unit_conversion import convert as convert
from ._data.unit_conversion import normalise_unit as normalise_unit
from ._data.unit_conversion import parse as parse
from ._data.unit_conversion import same_dimension as same_dimension
from ._data.unit_conversion import unit_label as unit_label
from ._inference.method import Method as Method
from ._inference.problem import Problem as Problem
from ._inference.record import Record as Record

# a model on readings: its frame, its unknowns, the problem, and how a posterior is drawn
from ._model.effect import list_forms as list_forms
from ._model.formula import Formula as Formula
from ._model.frame import build_frame as build_frame
from ._model.frame import reference_of as reference_of
from ._model.installed import list_installed as list_installed
from ._model.parameters import Unknowns as Unknowns
from ._model.parameters import bind as bind
from ._report import plot_colours as plot_colours
from ._report.report import Pictures as Pictures
from ._report.result_json import Chapter as Chapter
from ._report.result_json import Foreword as Foreword
from ._report.result_json import versions as versions
from ._report.save_search import draw_search as draw_search
from ._report.save_search import save_search as save_search
from ._report.save_search import write_search as write_search
from ._report.whole_folder import MANIFEST as MANIFEST
from ._report.whole_folder import guard_drawing as guard_drawing
from ._report.whole_folder import read_hashes as read_hashes
from ._report.whole_folder import replace_folder as replace_folder
from ._search.calibrate import QUICK as QUICK

# the search: structures, their posterior, the loop over them, its steps
from ._search.calibrate import StepwiseSearch as StepwiseSearch
from ._search.calibrate import check_step as check_step
from ._search.discover import SEARCH_TIME_SHARE as SEARCH_TIME_SHARE
from ._search.discover import enumerate_structures as enumerate_structures
from ._search.gate import assess_steps as assess_steps
from ._search.library import Library as Library
from ._search.noise_laws import list_laws as list_laws
from ._search.own_files import is_file_reference as is_file_reference
from ._search.posterior import Posterior as Posterior
from ._search.search_path import Step as Step
from ._search.search_path import steps_table as steps_table
from ._search.structures import SIZE_FACTORS as SIZE_FACTORS
from ._search.structures import Structure as Structure
from ._search.walk import explore as explore

# readings before they are measurements: tables, headers, columns, checks, rows of poses
from ._tables.open_table import MAX_BYTES as MAX_BYTES
from ._tables.open_table import SUFFIXES as SUFFIXES
from ._tables.open_table import open_table as open_table
from ._tables.raw_table import Objection as Objection
from ._tables.raw_table import Objections as Objections
from ._tables.raw_table import Table as Table
from ._tables.raw_table import as_format as as_format
from ._tables.raw_table import load_whole as load_whole
from ._tables.raw_table import option as option
from ._tables.raw_table import unusable as unusable

# an equation in use
from ._use.budget import format_inputs as format_inputs
from ._use.budget import list_budget_claims as list_budget_claims
from ._use.compensation_program import HISTORY_KINDS as HISTORY_KINDS

# corrections, and the files that they are written to
from ._use.compensation_program import NOT_RELIABLE as NOT_RELIABLE
from ._use.compensation_program import add_margin as add_margin
from ._use.compensation_program import list_average_claims as list_average_claims
from ._use.correction_files import CorrectionKind as CorrectionKind
from ._use.correction_files import as_text as as_text
from ._use.correction_files import choose_format as choose_format
from ._use.correction_files import choose_name as choose_name
from ._use.correction_files import format_guard as format_guard
from ._use.correction_files import name_sensors as name_sensors
from ._use.correction_files import render_json as render_json
from ._use.correction_files import wrap_writer as wrap_writer
from ._use.operating_equation import ALL_DRAWS as ALL_DRAWS
from ._use.operating_equation import STIMULUS as STIMULUS
from ._use.operating_equation import equation_in_use as equation_in_use
