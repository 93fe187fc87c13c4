"""Rows of a curve on disk; without lightning, which takes seconds to import."""

import csv
from pathlib import Path

Row = dict[str, float]
"""Numbers by name."""


def write_rows(path: Path, rows: list[Row]) -> None:
    """A CSV file of rows that need not have the same columns."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows({name: f"{value:.10g}" for name, value in row.items()} for row in rows)
