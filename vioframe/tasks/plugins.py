"""``task=plugins``: who is installed, what each offers, and whether it imports."""

from typing import TYPE_CHECKING

from vioframe.plugins import core_conf, discover, import_problem

if TYPE_CHECKING:
    from omegaconf import DictConfig


def run(config: "DictConfig") -> int:
    """List the plugin packages; a plugin that does not import is shown, and harms nobody."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="vioframe plugins", title_justify="left")
    for heading in ("package", "distribution", "version"):
        table.add_column(heading, no_wrap=True)
    table.add_column("offers", overflow="fold")
    table.add_column("import", no_wrap=True)
    problems = []
    for found in discover():
        problem = import_problem(found)
        table.add_row(
            found.package,
            found.distribution,
            found.version,
            "\n".join(_by_group(found.options)) or "nothing",
            "ok" if problem is None else "[red]fails[/red]",
        )
        if problem is not None:
            problems.append(f"{found.package} does not import, and nobody who does not choose it is harmed: {problem}")
    console = Console()
    console.print(table)
    for text in problems:
        console.print(text, markup=False)
    console.print(f"What belongs to no plugin: {core_conf()}")
    return 0


def _by_group(options: tuple[str, ...]) -> list[str]:
    groups: dict[str, list[str]] = {}
    for option in options:
        group, _, name = option.rpartition("/")
        groups.setdefault(group, []).append(name)
    return [f"{group}={','.join(names)}" for group, names in groups.items()]
