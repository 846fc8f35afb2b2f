"""The document's table of zero rate over temperature, as files."""

from pathlib import Path

TABLE = Path(__file__).parent / "data" / "zero_rate_table.csv"
TABLE_VOLTS = Path(__file__).parent / "data" / "zero_rate_table_volts.csv"
