"""Compose a config as the command line would, for tests that stay in one process."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from vioframe.build import build
from vioframe.errors import ConfigError
from vioframe.pipeline import SLOTS
from vioframe.plugins import core_conf, discover, extend_hydra


@contextmanager
def composer() -> Iterator[None]:
    """Hydra's compose API over vioframe's configs and those of every plugin."""
    GlobalHydra.instance().clear()
    extend_hydra()
    with initialize_config_dir(str(core_conf()), version_base="1.3"):
        yield


def composed(*overrides: str) -> DictConfig:
    """The config that these overrides of the command line give; outside a run, no tracker."""
    with composer():
        return compose("config", overrides=["tracker=none", *overrides])


def built(slot: str, name: str, *overrides: str):
    """The part that ``slot=name`` and further overrides build; skips the test where there is no torch for it."""
    try:
        return build(composed(f"{slot}={name}", *overrides), slot, SLOTS[slot], name)
    except ConfigError as error:
        if "vioframe[learn]" in str(error):
            pytest.skip(str(error))
        raise


def offered(group: str) -> list[str]:
    """Names of all options in a group, of the core and of every plugin."""
    folders = [core_conf(), *(found.conf for found in discover() if found.conf is not None)]
    return sorted({path.stem for folder in folders for path in (folder / group).glob("*.yaml")})
