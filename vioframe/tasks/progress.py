"""Progress bars on the terminal (stderr): of the frames of one sequence, and of a share of some work."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn


@contextmanager
def frame_progress(name: str, frame_count: int, *, shown: bool) -> Iterator[Callable[[int], None]]:
    """Yield a function that takes the number of image pairs done, and shows it."""
    if not shown:
        yield lambda done: None
        return
    from rich.progress import MofNCompleteColumn, TextColumn

    with _bar(MofNCompleteColumn(), TextColumn("frames  {task.fields[rate]}")) as bar:
        task = bar.add_task(name, total=max(frame_count - 1, 0), rate="")

        def advance(done: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, rate="" if speed is None else f"{speed:.0f}/s")

        yield advance


@contextmanager
def share_progress(name: str, total: float, *, shown: bool) -> Iterator[Callable[[float], None]]:
    """Yield a function that takes how much of ``total`` is done, and shows it in per cent."""
    if not shown:
        yield lambda done: None
        return
    from rich.progress import TaskProgressColumn

    with _bar(TaskProgressColumn()) as bar:
        task = bar.add_task(name, total=total)
        yield lambda done: bar.update(task, completed=done)


def _bar(*told: "ProgressColumn") -> "Progress":
    """A bar with its name before it, and after it what it tells and the times."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    times = TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()
    return Progress(
        TextColumn("{task.description}"), BarColumn(), *told, *times, console=Console(stderr=True), refresh_per_second=4
    )
