"""Find plugin packages without importing them, and lend their configs to Hydra.

A plugin is any installed package with an entry point in the group ``vioframe.plugins``. Its ``conf/``
folder joins Hydra's search path as ``file://``: with ``pkg://`` one stranger's raising ``__init__`` would
kill every run.
"""

import functools
import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path

from vioframe.errors import PluginError

ENTRY_POINT_GROUP = "vioframe.plugins"


@dataclass(frozen=True, slots=True, kw_only=True)
class PluginPackage:
    """One installed plugin package.

    Attributes:
        name: of its entry point.
        package: top-level import name.
        distribution: what pip calls it.
        version: of the distribution.
        folder: of the package, or None where it cannot be located.
        options: ``group/name`` of every config it offers.
    """

    name: str
    package: str
    distribution: str
    version: str
    folder: Path | None
    options: tuple[str, ...]

    @property
    def conf(self) -> Path | None:
        """Its config folder, or None where it offers none."""
        folder = None if self.folder is None else self.folder / "conf"
        return folder if folder is not None and folder.is_dir() else None


def core_conf() -> Path:
    """The folder of configs that belong to no plugin: packaged beside the code, or at the top of a checkout."""
    package = Path(__file__).parent
    packaged = package / "conf"
    return packaged if packaged.is_dir() else package.parent / "conf"


@functools.cache
def discover() -> tuple[PluginPackage, ...]:
    """All installed plugin packages, by name; nothing of theirs is imported.

    Raises:
        PluginError: two packages offer the same option, or one takes a core option's name.
    """
    packages = sorted(
        (_locate(entry) for entry in entry_points(group=ENTRY_POINT_GROUP)),
        key=lambda found: (found.name, found.distribution),
    )
    refuse_clashes(packages, core_conf())
    return tuple(packages)


def _locate(entry: EntryPoint) -> PluginPackage:
    package = entry.value.partition(":")[0].partition(".")[0].strip()
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):
        spec = None
    places = list(spec.submodule_search_locations or []) if spec is not None else []
    folder = Path(places[0]) if places else None
    return PluginPackage(
        name=entry.name,
        package=package,
        distribution=entry.dist.name if entry.dist is not None else "unknown",
        version=entry.dist.version if entry.dist is not None else "unknown",
        folder=folder,
        options=_options(folder / "conf") if folder is not None else (),
    )


def _options(conf: Path) -> tuple[str, ...]:
    return tuple(sorted(path.relative_to(conf).with_suffix("").as_posix() for path in conf.rglob("*.yaml")))


def refuse_clashes(packages: Iterable[PluginPackage], core: Path) -> None:
    """Refuse two offers of one option; Hydra alone would silently take the first.

    Raises:
        PluginError: names the option and both distributions.
    """
    offered: dict[str, tuple[str, Path | None]] = {option: ("vioframe itself", core) for option in _options(core)}
    for found in packages:
        for option in found.options:
            owner = (f"{found.package} (distribution {found.distribution})", found.folder)
            if option in offered:
                group, _, name = option.rpartition("/")
                first, second = offered[option], owner
                raise PluginError(
                    f"{group}={name} is offered twice: by {first[0]} in {first[1]} and by {second[0]} in "
                    f"{second[1]}; uninstall one of them, or rename its conf/{option}.yaml"
                )
            offered[option] = owner


def import_problem(found: PluginPackage) -> str | None:
    """Import one plugin; return why that fails, in one line, or None."""
    if found.folder is None:
        return f"package {found.package} is not installed where Python can find it"
    try:
        importlib.import_module(found.package)
    except Exception as error:  # noqa: BLE001 - a stranger's import may raise anything; it is reported, not hidden
        return f"{type(error).__name__}: {error}".splitlines()[0]
    return None


def extend_hydra() -> None:
    """Put every plugin's ``conf/`` on Hydra's search path; to be called before ``hydra.main``.

    Raises:
        PluginError: two packages offer the same option.
    """
    from hydra.core.config_search_path import ConfigSearchPath
    from hydra.core.plugins import Plugins
    from hydra.plugins.search_path_plugin import SearchPathPlugin

    folders = [(found.package, found.conf) for found in discover() if found.conf is not None]

    class PluginConfigs(SearchPathPlugin):
        """Adds the folders found above; the search path names the package each comes from."""

        def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
            for package, conf in folders:
                search_path.append(provider=package, path=f"file://{conf}")

    Plugins.instance().register(PluginConfigs)
