"""A study in the terminal: one table of the metric that decides, and a sentence a variant."""

from typing import TYPE_CHECKING

from vioframe.study.summary import StudySummary

if TYPE_CHECKING:
    from rich.console import Console


def print_study(summary: StudySummary, console: "Console | None" = None) -> None:
    """Print medians over seeds by variant and value, what the curves say, and what failed."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if console is None:
        console = Console()
        if not console.is_terminal:
            # A log file has no width; 80 columns would fold every row.
            console = Console(width=160)
    study, column = summary.study, summary.columns[0]
    seeds = f"median of {len(study.seeds)} seeds" if len(study.seeds) > 1 else f"seed {study.seeds[0]}"
    # Units stand in brackets, which rich would take for its own.
    table = Table(title=Text(f"{study.title}: {column.title}, {seeds}"), title_justify="left")
    table.add_column(Text(study.axis), overflow="fold")
    for value in study.all_values():
        table.add_column(study.shown(value), justify="right")
    for variant in study.chosen:
        cells = []
        for value in study.all_values():
            spread, loss = summary.spread(variant, value, column), summary.loss(variant, value, column)
            if spread is None:
                cells.append(Text("–", style="dim"))
                continue
            within = loss is not None and loss <= study.tolerance
            cells.append(Text(f"{spread.median:.{column.decimals}f}", style="green" if within else ""))
        table.add_row(Text(variant), *cells)
    console.print(table)
    for sentence in summary.sentences():
        console.print(sentence, markup=False, highlight=False)
    for error, cells_failed in summary.failures().items():
        told = ", ".join(str(cell) for cell in cells_failed[:4])
        more = f" and {len(cells_failed) - 4} more" if len(cells_failed) > 4 else ""
        console.print(f"failed: {told}{more}: {error}", style="red", markup=False, highlight=False)
