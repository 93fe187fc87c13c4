"""The results in the terminal: a table a split, and one of single pairs where there are few."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vioframe.features.evaluation import Summary
from vioframe.features.protocol import FeatureProtocol
from vioframe.features.scoring import PairScores

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

ABSENT = "–"
"""What a method does not have, such as descriptors."""
FEW_PAIRS = 6
"""Up to so many pairs are also shown one by one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column of the table.

    Attributes:
        title: with the unit on a second line.
        value: of a summary; None where the method does not have it.
        decimals: shown.
        sign: 1 where more is better, −1 where less is, 0 where neither.
    """

    title: str
    value: Callable[[Summary], float | None]
    decimals: int
    sign: int

    def show(self, summary: Summary) -> str:
        """The cell."""
        value = self.value(summary)
        return ABSENT if value is None else f"{value:.{self.decimals}f}"

    def best(self, summaries: Sequence[Summary]) -> str:
        """The best cell as it is shown, or nothing."""
        values = [value for value in map(self.value, summaries) if value is not None]
        if self.sign == 0 or len(values) < 2:
            return ""
        return f"{max(values) if self.sign > 0 else min(values):.{self.decimals}f}"


def _at(epsilon_px: int) -> Callable[[Summary], float | None]:
    return lambda summary: summary.accuracy_at(epsilon_px)


COLUMNS = (
    Column(title="points\n", value=lambda s: s.points, decimals=0, sign=0),
    Column(title="repeat-\nability", value=lambda s: s.repeatability, decimals=3, sign=1),
    Column(title="localisation\npx", value=lambda s: s.localisation_px, decimals=2, sign=-1),
    Column(title="NN\nmAP", value=lambda s: s.mean_average_precision, decimals=3, sign=1),
    Column(title="matching\nscore", value=lambda s: s.matching_score, decimals=3, sign=1),
    Column(title="matches\n", value=lambda s: s.matches, decimals=0, sign=0),
    Column(title="right\n", value=lambda s: s.correct, decimals=0, sign=1),
    Column(title="homography\n1 px", value=_at(1), decimals=3, sign=1),
    Column(title="\n3 px", value=_at(3), decimals=3, sign=1),
    Column(title="\n5 px", value=_at(5), decimals=3, sign=1),
    Column(title="time\nms", value=lambda s: s.milliseconds, decimals=1, sign=-1),
    Column(title="CPU\nms", value=lambda s: s.cpu_milliseconds, decimals=1, sign=-1),
)


def by_split(summaries: Sequence[Summary]) -> dict[str, list[Summary]]:
    """Summaries of each split, in order of appearance, methods in theirs."""
    splits: dict[str, list[Summary]] = {}
    for summary in summaries:
        splits.setdefault(summary.split, []).append(summary)
    return splits


def title_of(split: str, summaries: Sequence[Summary]) -> str:
    """What a table of a split is called."""
    pairs = summaries[0].pairs
    return f"{split}, {pairs} pair{'s' * (pairs != 1)}"


def print_summaries(
    summaries: Sequence[Summary],
    scores: Mapping[str, Sequence[PairScores]],
    protocol: FeatureProtocol,
    threads: str,
    console: "Console | None" = None,
) -> None:
    """Print a table for each split, the best of each column in bold green, and single pairs where they are few.

    Args:
        summaries: of all methods and splits.
        scores: of all pairs, by method.
        protocol: see there.
        threads: what the times were measured with.
        console: standard output where none is given.
    """
    from rich.console import Console
    from rich.text import Text

    if console is None:
        console = Console()
        if not console.is_terminal:
            # A log file has no width; 80 columns would fold every row.
            console = Console(width=140)
    for split, rows in by_split(summaries).items():
        table = _new_table(title_of(split, rows))
        for column in COLUMNS:
            table.add_column(Text(column.title), justify="right")
        best = [column.best(rows) for column in COLUMNS]
        for row in rows:
            cells = [column.show(row) for column in COLUMNS]
            styled = [
                Text(cell, style="bold green" if cell == top else "dim" if cell == ABSENT else "")
                for cell, top in zip(cells, best, strict=True)
            ]
            table.add_row(Text(row.method), *styled)
        console.print(table)
    if all(len(of_method) <= FEW_PAIRS for of_method in scores.values()):
        console.print(_pair_table(scores))
    console.print(protocol.sentence(), style="dim", markup=False, highlight=False)
    console.print(
        f"time: median of extraction, a picture, on the clock and of the processor; {threads}",
        style="dim",
        markup=False,
        highlight=False,
    )


def pair_cell(score: PairScores) -> str:
    """Right matches of all, and the corner error of the homography; repeated points for a bare detector."""
    if score.descriptors is None:
        return f"{score.repeatability:.2f} repeated"
    one = score.descriptors
    error = "none" if one.corner_error_px == float("inf") else f"{one.corner_error_px:.1f} px"
    return f"{one.correct}/{one.matches}, {error}"


def _pair_table(scores: Mapping[str, Sequence[PairScores]]) -> "Table":
    from rich.text import Text

    names = [score.pair for score in next(iter(scores.values()))]
    # Pairs of one sequence share its name.
    sequences = {name.rpartition("_")[0] for name in names}
    shared = sequences.pop() if len(sequences) == 1 else ""
    title = f"{shared}: " if shared else ""
    table = _new_table(f"{title}right matches of all, mean error of the homography's corners")
    for name in names:
        table.add_column(Text(name.removeprefix(f"{shared}_")), justify="right")
    for method, of_method in scores.items():
        table.add_row(Text(method), *(Text(pair_cell(score)) for score in of_method))
    return table


def _new_table(title: str) -> "Table":
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    return table
