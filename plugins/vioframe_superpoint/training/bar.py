"""How far a stage is, on the terminal."""

from collections.abc import Mapping
from typing import Any


class Bar:
    """A progress bar on the terminal (stderr).

    Args:
        title: of what.
        total: steps.
        unit: of a step, for the speed.
    """

    def __init__(self, title: str, total: int, unit: str = "it") -> None:
        self._title = title
        self._total = total
        self._unit = unit
        self._progress: Any = None
        self._task: Any = None
        self._figures = ""

    def show(self, done: int) -> None:
        """Put it up, if it is not."""
        if self._progress is not None:
            return
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[told]}"),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=Console(stderr=True),
            refresh_per_second=2,
        )
        self._progress.start()
        self._task = self._progress.add_task(self._title, total=self._total, completed=done, told="")

    def advance(self, done: int, per_second: float) -> None:
        """Say how far it is."""
        if self._progress is not None:
            self._progress.update(self._task, completed=done, told=f"{per_second:.2f} {self._unit}/s{self._figures}")

    def tell(self, figures: Mapping[str, float]) -> None:
        """Show figures of a validation from now on."""
        self._figures = "".join(f"  {name} {value:.3f}" for name, value in figures.items() if "/" not in name)

    def close(self) -> None:
        """Take it down."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
