"""The results in the terminal."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.evaluation.attempts import start_text
from vioframe.evaluation.rows import Row
from vioframe.evaluation.wording import (
    UNDEFINED,
    accuracy_lines,
    brief_accuracy_lines,
    calibration_text,
    counter_text,
    failure_text,
    has_run,
    join,
    output_name,
    protocol_text,
    reasons,
    running_lines,
    show,
    significant,
    total_ms,
)

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table
    from rich.text import Text

# Spaces and rule between two columns.
_GUTTER = 3


def print_rows(rows: Sequence[Row], folder: Path, *, hints: Mapping[str, str] | None = None) -> None:
    """Print the results and where they are.

    Args:
        rows: one per sequence.
        folder: the output folder.
        hints: what else there is to see and the command that shows it, by the one word that introduces it.
    """
    from rich.console import Console

    console = Console()
    for part in render_rows(rows, console.width):
        console.print(part)
    report = folder / "report.html"
    print_places(folder, {"report": str(report) if report.exists() else "", **(hints or {})})


def print_places(folder: Path, hints: Mapping[str, str]) -> None:
    """Print where the results are.

    Args:
        folder: the output folder.
        hints: what else there is to see, by the one word that introduces it; empty ones are left out.
    """
    from rich.console import Console

    console = Console()
    console.print(f"results in {folder}", style="bold", soft_wrap=True, highlight=False, markup=False)
    for label, text in hints.items():
        if text:
            # As wide as "results in".
            console.print(f"{label:<10} {text}", soft_wrap=True, highlight=False, markup=False)


def render_rows(rows: Sequence[Row], width: int = 120) -> "list[RenderableType]":
    """What :func:`print_rows` prints: one long table for one sequence, a row each for several."""
    parts: list[RenderableType] = []
    if len(rows) == 1:
        parts += [_single(rows[0])] if has_run(rows[0]) else []
    elif rows:
        parts += _many(rows, width)
    for row in rows:
        parts += _notes(row, name=len(rows) > 1)
    return parts + _protocols(rows)


def _new_table(title: str) -> "Table":
    from rich import box
    from rich.table import Table

    return Table(title=title or None, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)


def _cell(text: str) -> "Text":
    from rich.text import Text

    return Text(text, style="dim" if text == UNDEFINED else "")


def _single(row: Row) -> "Table":
    table = _new_table(f"{row['sequence']}: {row['status']}")
    final = row.get("final")
    outputs: list[Mapping[str, object]] = [row, final] if isinstance(final, Mapping) else [row]
    table.add_column("")
    for output in outputs:
        table.add_column(output_name(output), justify="right")
    table.add_column("", style="dim")

    def add(label: str, values: Sequence[str], unit: str) -> None:
        filling = [""] * (len(outputs) - len(values))
        table.add_row(label, *map(_cell, values), *filling, unit)

    for line in accuracy_lines(row):
        add(line.label, [show(output, line, unit=False) for output in outputs], line.unit)
    table.add_section()
    for line in running_lines(row):
        add(line.label, [show(row, line, unit=False)], line.unit)
    parts = row.get("ms_per_frame")
    if isinstance(parts, Mapping):
        table.add_section()
        add("time per frame", [significant(float(parts["total"]))], "ms")
        for part, milliseconds in parts.items():
            if part != "total":
                add(f"  {part}", [significant(float(milliseconds))], "ms")
    return table


def _many(rows: Sequence[Row], width: int) -> "list[RenderableType]":
    """A row for each sequence; the columns in as many tables as the width asks for."""
    outputs: list[tuple[str, Row, Mapping[str, object]]] = []
    for row in rows:
        outputs.append((str(row["sequence"]), row, row))
        final = row.get("final")
        if isinstance(final, Mapping):
            outputs.append(("  final", row, final))
    names = [name for name, _, _ in outputs]
    widest_name = max(len("sequence"), *map(len, names))
    tables: list[RenderableType] = []
    chunk: list[list[str]] = []
    empty = width - widest_name - _GUTTER
    room = empty
    for column in _columns(rows, outputs):
        needed = _GUTTER + max(len(text) for cell in column for text in cell.split("\n"))
        if chunk and needed > room:
            tables.append(_table_of(names, chunk))
            chunk, room = [], empty
        chunk.append(column)
        room -= needed
    return [*tables, _table_of(names, chunk)]


def _columns(rows: Sequence[Row], outputs: Sequence[tuple[str, Row, Mapping[str, object]]]) -> list[list[str]]:
    """Heading and cells of every column; what a final trajectory cannot have stays empty."""
    fullest = max(rows, key=len)
    columns = [["\nstatus", *(str(row["status"]) if output is row else "" for _, row, output in outputs)]]
    accuracy = brief_accuracy_lines(fullest)
    # How much of the recording the other numbers speak of comes first.
    running = sorted(running_lines(fullest), key=lambda line: line.key != "completion")
    for line in (*running[:1], *accuracy, *running[1:]):
        cells = [show(output, line, unit=False) if line.key in output else "" for _, _, output in outputs]
        columns.append([f"{line.short}\n{line.unit}", *cells])
    if "ms_per_frame" in fullest:
        columns.append(["time\nms/frame", *(total_ms(row) if output is row else "" for _, row, output in outputs)])
    return columns


def _table_of(names: Sequence[str], columns: Sequence[Sequence[str]]) -> "Table":
    table = _new_table("")
    table.add_column("\nsequence", no_wrap=True)
    for column in columns:
        table.add_column(column[0], justify="right", no_wrap=True)
    for index, name in enumerate(names, start=1):
        table.add_row(name, *(_cell(column[index]) for column in columns))
    return table


def _notes(row: Row, *, name: bool) -> "list[RenderableType]":
    """What went wrong, what happened, and why a metric is missing."""
    from rich.text import Text

    prefix = f"{row['sequence']}: " if name else ""
    notes: list[RenderableType] = []
    if row.get("error"):
        notes.append(Text(prefix + failure_text(row), style="bold red"))
    started = start_text(row)
    if started:
        notes.append(Text(f"{prefix}{started}", style="yellow"))
    calibrated = calibration_text(row)
    if calibrated:
        notes.append(Text(f"{prefix}{calibrated}", style="dim"))
    counted = counter_text(row)
    if counted:
        notes.append(Text(f"{prefix}{counted}", style="yellow"))
    if has_run(row):
        # Where nothing ran, the error has said everything.
        for reason, labels in reasons(row).items():
            notes.append(Text(f"{prefix}undefined: {join(labels)} ({reason})", style="dim"))
    return notes


def _protocols(rows: Sequence[Row]) -> "list[RenderableType]":
    """The protocol of each row, once where they agree."""
    from rich.text import Text

    by_text: dict[str, list[str]] = {}
    for row in rows:
        if has_run(row):
            by_text.setdefault(protocol_text(row), []).append(str(row["sequence"]))
    if len(by_text) == 1:
        return [Text(text, style="dim") for text in by_text]
    return [Text(f"{', '.join(names)}: {text}", style="dim") for text, names in by_text.items()]
