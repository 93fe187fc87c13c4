"""A study in the terminal: one table of the metric that decides, variants beside the baseline, and sentences."""

import math
from typing import TYPE_CHECKING

from vioframe.evaluation.paired import show_p, show_ratio
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
    # Units stand in brackets, which rich would take for its own.
    table = Table(title=Text(f"{study.title}: {column.title}, {summary.runs_told()}"), title_justify="left")
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
            within = loss is not None and loss <= study.tolerance and math.isfinite(spread.median)
            text = spread.text(spread.median, column.decimals)
            if spread.failed and math.isfinite(spread.median):
                text += f" ×{spread.failed}"
            cells.append(Text(text, style="green" if within else ""))
        table.add_row(Text(variant), *cells)
    console.print(table)
    if study.least_completion > 0.0:
        told = f"×: runs that tracked less than {100.0 * study.least_completion:g} % of their recording, and failed"
        console.print(told, style="dim", highlight=False)
    _print_comparisons(summary, console)
    for sentence in summary.sentences():
        console.print(sentence, markup=False, highlight=False)
    for error, cells_failed in summary.failures().items():
        told = ", ".join(str(cell) for cell in cells_failed[:4])
        more = f" and {len(cells_failed) - 4} more" if len(cells_failed) > 4 else ""
        console.print(f"failed: {told}{more}: {error}", style="red", markup=False, highlight=False)


def _print_comparisons(summary: StudySummary, console: "Console") -> None:
    from rich.table import Table
    from rich.text import Text

    column = summary.columns[0]
    found = summary.comparisons(column)
    if not found:
        return
    title = f"{column.title}, beside {summary.study.baseline}, pairs of the same recording and seed"
    table = Table(title=Text(title), title_justify="left")
    for head in (
        "variant",
        "at",
        "ratio of medians (95 %)",
        "median of ratios (95 %)",
        "better",
        "worse",
        "pairs",
        "p",
    ):
        table.add_column(head, justify="left" if head in ("variant", "at") else "right")
    for variant, where, compared in found:
        counts = (compared.better, compared.worse, compared.pairs)
        shown = show_ratio(compared.of_medians), show_ratio(compared.of_pairs)
        table.add_row(variant, where, *shown, *map(str, counts), show_p(compared.p_value))
    console.print(table)
    console.print("p: Wilcoxon's signed-rank test, two-sided, each by itself", style="dim", highlight=False)
