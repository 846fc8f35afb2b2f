"""Path of source 1's table of zero-rate output against temperature."""

from pathlib import Path

TABLE = Path(__file__).parent / "data" / "zero_rate_table.csv"
