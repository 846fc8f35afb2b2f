"""Path of the table of zero-rate output against temperature of source 1."""

from pathlib import Path

TABLE = Path(__file__).parent / "data" / "zero_rate_table.csv"
