"""The document's table of zero rate over temperature, as a file."""

from pathlib import Path

TABLE = Path(__file__).parent / "data" / "zero_rate_table.csv"
