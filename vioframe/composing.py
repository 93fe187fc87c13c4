"""Configs composed inside a running process, as the command line would compose them."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from vioframe.errors import ConfigError
from vioframe.plugins import core_conf, extend_hydra


@dataclass(frozen=True, slots=True, kw_only=True)
class Composed:
    """A config as a job gets it.

    Attributes:
        config: the whole, interpolations unresolved.
        choices: the option chosen in each group, such as ``{"fuser": "ekf"}``.
    """

    config: DictConfig
    choices: dict[str, str]


class Composer(AbstractContextManager["Composer"]):
    """Hydra's compose API inside a running job: the application's own state is put back afterwards."""

    def __enter__(self) -> Self:
        self._before = GlobalHydra.instance().hydra
        GlobalHydra.instance().clear()
        extend_hydra()
        self._inner = initialize_config_dir(str(core_conf()), version_base="1.3")
        self._inner.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._inner.__exit__(kind, error, traceback)
        GlobalHydra.instance().hydra = self._before

    def compose(self, overrides: Sequence[str]) -> Composed:
        """The config of a command line with these overrides; of two that set the same, the later counts.

        Raises:
            ConfigError: Hydra refuses them; its sentence and the overrides.
        """
        try:
            config = compose("config", overrides=list(overrides), return_hydra_config=True)
        except (HydraException, OmegaConfBaseException) as error:
            first = str(error).strip().partition("\n")[0]
            raise ConfigError(f"{' '.join(overrides)} cannot be composed: {first}") from error
        choices = {group: str(option) for group, option in config.hydra.runtime.choices.items()}
        with open_dict(config):
            del config["hydra"]
        return Composed(config=config, choices=choices)
