"""File with the table of zero rate over temperature of source 1."""

from pathlib import Path

TABLE = Path(__file__).parent / "data" / "zero_rate_table.csv"
