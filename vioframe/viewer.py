"""What ``viewer=`` builds: something that shows a sequence while it runs."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from vioframe.build import build
from vioframe.types import Measurement, NavState, SensorRig, Trajectory


class Viewer(ABC):
    """Watches a pipeline (see :meth:`vioframe.pipeline.Pipeline.observe`); its time counts to no part.

    For each sequence ``setup`` once, ``watch`` after every window, ``close`` once, also when the run was
    stopped early.
    """

    @abstractmethod
    def setup(self, sequence: str, rig: SensorRig, ground_truth: Trajectory | None, folder: Path) -> None:
        """Begin a sequence.

        Args:
            sequence: its name.
            rig: calibration.
            ground_truth: true poses of the body (IMU clock), or None.
            folder: where files go; it exists.

        Raises:
            ConfigError: there is nowhere to show it.
        """

    @abstractmethod
    def watch(self, measurement: Measurement, states: list[NavState]) -> None:
        """Show one window and the states that it gave, oldest first."""

    @abstractmethod
    def close(self) -> None:
        """End the sequence; without ``setup`` it does nothing."""

    @property
    def hint(self) -> str:
        """How to look at what was shown last: a command or an address; empty when there is nothing."""
        return ""


def build_viewer(config: DictConfig, choices: Mapping[str, str]) -> Viewer | None:
    """The viewer of ``config``, or None with ``viewer=none``.

    Raises:
        ConfigError: it cannot be built, such as when its package is not installed.
    """
    if not OmegaConf.select(config, "viewer"):
        return None
    return build(config, "viewer", Viewer, choices.get("viewer", ""))
