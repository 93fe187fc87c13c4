"""The summary of a sweep as a table: in the terminal, and in MLflow."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from vioframe.sweep.summary import Column, SeedGroup, Summary

if TYPE_CHECKING:
    from rich.console import Console


def print_table(summary: Summary, console: "Console | None" = None) -> None:
    """Print one row for each job, the best of each column in bold green, and the groups over seeds below."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if console is None:
        console = Console()
        if not console.is_terminal:
            # A log file has no width; 80 columns would fold every row.
            console = Console(width=140)
    columns = summary.columns()
    finished = sum(job.status == "finished" for job in summary.jobs)
    table = Table(title=f"Sweep: {finished} of {len(summary.jobs)} jobs finished", title_justify="left")
    table.add_column("#", justify="right")
    table.add_column("choices", overflow="fold")
    for column in columns:
        table.add_column(Text(column.title), justify="right")
    table.add_column("status", overflow="fold")
    best = {column.key: column.winner(summary.values(column)) for column in columns}
    for job in summary.jobs:
        good = job.status == "finished"
        cells = [Text(str(job.number)), Text(summary.label(job.overrides))]
        for column in columns:
            value = job.metrics.get(column.key)
            if value is None:
                cells.append(Text("undefined" if good else "–", style="dim"))
            else:
                winner = good and value == best[column.key]
                cells.append(Text(column.show(value), style="bold green" if winner else "" if good else "dim"))
        cells.append(Text("finished") if good else Text(f"{job.status}: {job.error}", style="red"))
        table.add_row(*cells)
    console.print(table)
    if summary.groups:
        console.print(_seed_table(summary, columns))
    if summary.caution():
        console.print(Text(summary.caution(), style="yellow"))


def _seed_table(summary: Summary, columns: Sequence[Column]) -> object:
    from rich.table import Table
    from rich.text import Text

    table = Table(title="Median over seeds (smallest to largest)", title_justify="left")
    table.add_column("choices", overflow="fold")
    for column in columns:
        table.add_column(Text(column.title), justify="right")
    table.add_column("seeds finished", justify="right")
    for group in summary.groups:
        complete = group.finished == group.jobs
        cells = [Text(summary.label(group.choices))]
        for column in columns:
            medians = [
                other.median[column.key]
                for other in summary.groups
                if other.finished == other.jobs and column.key in other.median
            ]
            value = group.median.get(column.key)
            winner = complete and value is not None and value == column.winner(medians)
            cells.append(Text(_spread(group, column), style="bold green" if winner else ""))
        cells.append(Text(f"{group.finished} of {group.jobs}", style="" if complete else "red"))
        table.add_row(*cells)
    return table


def _spread(group: SeedGroup, column: Column) -> str:
    if column.key not in group.median:
        return "undefined" if group.finished else "–"
    low, high = column.show(group.smallest[column.key]), column.show(group.largest[column.key])
    return f"{column.show(group.median[column.key])} ({low} to {high})"


def markdown_table(summary: Summary) -> str:
    """Write the table as Markdown, which MLflow shows as the description of the sweep's run."""
    columns = summary.columns()
    lines = [_markdown_row(["#", "choices", *(column.title for column in columns), "status"])]
    lines.append("|" + "---|" * (len(columns) + 3))
    best = {column.key: column.winner(summary.values(column)) for column in columns}
    for job in summary.jobs:
        good = job.status == "finished"
        cells = [str(job.number), summary.label(job.overrides)]
        for column in columns:
            value = job.metrics.get(column.key)
            text = column.show(value) if good or value is not None else "–"
            cells.append(f"**{text}**" if good and value is not None and value == best[column.key] else text)
        cells.append("finished" if good else f"**{job.status}**: {job.error}")
        lines.append(_markdown_row(cells))
    if summary.groups:
        lines += ["", _markdown_row(["median over seeds", *(column.title for column in columns), "seeds finished"])]
        lines.append("|" + "---|" * (len(columns) + 2))
        for group in summary.groups:
            spreads = [_spread(group, column) for column in columns]
            counted = f"{group.finished} of {group.jobs}"
            lines.append(_markdown_row([summary.label(group.choices), *spreads, counted]))
    if summary.caution():
        lines += ["", summary.caution()]
    return "\n".join(lines)


def _markdown_row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
