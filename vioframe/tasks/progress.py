"""Progress bars: of the frames of one sequence, and of a share of some work."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def frame_progress(name: str, frame_count: int, *, shown: bool) -> Iterator[Callable[[int], None]]:
    """Yield a function that takes the number of image pairs done, and shows it on the terminal (stderr)."""
    if not shown:
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("frames  {task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=4) as bar:
        task = bar.add_task(name, total=max(frame_count - 1, 0), rate="")

        def advance(done: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, rate="" if speed is None else f"{speed:.0f}/s")

        yield advance


@contextmanager
def share_progress(name: str, total: float, *, shown: bool) -> Iterator[Callable[[float], None]]:
    """Yield a function that takes how much of ``total`` is done, and shows it in per cent on the terminal (stderr)."""
    if not shown:
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=4) as bar:
        task = bar.add_task(name, total=total)
        yield lambda done: bar.update(task, completed=done)
