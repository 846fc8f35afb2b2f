"""The names of the workshop, each listed once. `lazy_loader` reads this file when `bayescal.workshop` is imported."""

# an annex, and what it may offer
# a calibration: its identity, its files, what stands against it; its part of a report
from ._calibration.check import why_not as why_not
from ._calibration.storage import identity as identity
from ._calibration.storage import sources_of as sources_of
from ._calibration.summary import summary as summary
from ._cli.commands import ExportCommand as ExportCommand

# commands: their options, what they are asked for, what they answer
from ._cli.options import Answer as Answer
from ._cli.options import AsJson as AsJson
from ._cli.options import ColumnOptions as ColumnOptions
from ._cli.options import Command as Command
from ._cli.options import DecisionRule as DecisionRule
from ._cli.options import InUse as InUse
from ._cli.options import ModelOptions as ModelOptions
from ._cli.options import Options as Options
from ._cli.options import ReadRequest as ReadRequest
from ._cli.options import SearchRequest as SearchRequest
from ._cli.options import Shared as Shared
from ._cli.options import channel_names as channel_names
from ._cli.options import drawn as drawn
from ._cli.options import named_numbers as named_numbers
from ._cli.options import named_values as named_values
from ._cli.options import names_in as names_in
from ._cli.options import opt as opt
from ._cli.options import refuse_missing as refuse_missing
from ._cli.request import CALIBRATION as CALIBRATION
from ._cli.request import compensator_from as compensator_from
from ._cli.request import compose as compose
from ._cli.request import instrument_named as instrument_named
from ._cli.request import load_saved as load_saved
from ._cli.request import method_named as method_named
from ._cli.request import of_units as of_units
from ._cli.request import open_request as open_request
from ._cli.request import own_effects as own_effects
from ._cli.request import reliable as reliable
from ._cli.request import searched as searched

# JSON, and the type that it must have
from ._core.as_json import as_json as as_json
from ._core.as_json import json_text as json_text
from ._core.as_json import write_json as write_json

# files: written whole or not at all; folders of results
from ._core.atomic_file import replacing_for_user as replacing_for_user
from ._core.atomic_file import result_folder as result_folder
from ._core.atomic_file import write_text as write_text

# text for people and for programs: numbers, names, tables
from ._core.formatting import WIDTH as WIDTH  # columns of a page
from ._core.formatting import number as number
from ._core.formatting import probability as probability
from ._core.formatting import with_error as with_error
from ._core.json_shape import as_type as as_type
from ._core.json_shape import parsed_json as parsed_json
from ._core.json_shape import read_json as read_json
from ._core.json_shape import read_toml as read_toml
from ._core.progress import print_notes as print_notes
from ._core.progress import stage as stage
from ._core.progress import tell as tell
from ._core.quoting import ascii_text as ascii_text
from ._core.quoting import c_comment as c_comment
from ._core.quoting import html_text as html_text
from ._core.quoting import identifier as identifier
from ._core.quoting import one_line as one_line
from ._core.quoting import python_words as python_words
from ._core.result_table import Printed as Printed
from ._core.result_table import ResultTable as ResultTable
from ._core.result_table import TableColumn as TableColumn
from ._core.result_table import plain_table as plain_table
from ._core.templates import template as template

# files of readings
from ._data.column import UNCERTAINTY as UNCERTAINTY
from ._data.header_matching import ReadOptions as ReadOptions
from ._data.header_matching import expected_columns as expected_columns

# units
from ._data.unit_conversion import STANDARD_GRAVITY as STANDARD_GRAVITY
from ._data.unit_conversion import base_unit as base_unit
from ._data.unit_conversion import convert as convert
from ._data.unit_conversion import normalised as normalised
from ._data.unit_conversion import parse as parse
from ._data.unit_conversion import pretty as pretty
from ._data.unit_conversion import same_dimension as same_dimension
from ._data.unit_conversion import unit_label as unit_label
from ._report.plots import new_figure as new_figure
from ._report.result_json import Chapter as Chapter
from ._report.result_json import Foreword as Foreword
from ._report.save_search import draw_search as draw_search
from ._report.save_search import save_search as save_search
from ._report.save_search import write_search as write_search
from ._report.whole_folder import MANIFEST as MANIFEST
from ._report.whole_folder import drawing as drawing
from ._report.whole_folder import files_of as files_of
from ._report.whole_folder import folders_of as folders_of
from ._report.whole_folder import whole_folder as whole_folder
from ._tables.open_table import open_table as open_table
from ._tables.raw_table import Objection as Objection
from ._tables.raw_table import Objections as Objections
from ._tables.raw_table import Table as Table
from ._tables.raw_table import as_format as as_format
from ._tables.raw_table import option as option
from ._tables.raw_table import unusable as unusable

# corrections, and the files that they are written to
from ._use.compensation_program import NOT_RELIABLE as NOT_RELIABLE
from ._use.compensation_program import CorrectionInUse as CorrectionInUse
from ._use.correction_files import CorrectionKind as CorrectionKind
from ._use.correction_files import as_data as as_data
from ._use.correction_files import as_text as as_text
from ._use.correction_files import format_of as format_of
from ._use.correction_files import in_form as in_form
from ._use.correction_files import include_guard as include_guard
from ._use.correction_files import load_correction as load_correction
from ._use.correction_files import names_in_unit as names_in_unit
from ._use.correction_files import sensor_name as sensor_name
