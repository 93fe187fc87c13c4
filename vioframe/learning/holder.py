"""What every part with a net does with it: make it when first asked for, load its weights, bring it to a device."""

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

from vioframe.errors import ConfigError
from vioframe.interfaces import HasNet
from vioframe.learning import require_torch

if TYPE_CHECKING:
    import torch
    from torch import nn

log = logging.getLogger(__name__)


class NetHolder:
    """The net of one part; importing this costs nothing, torch comes with :attr:`net`.

    Args:
        part: whose net it is; a file of weights is held against its architecture.
        slot: of the part, such as ``fuser``, for messages.
        name: its option there, such as ``lstm``.
        make: the net with random weights.
        weights: file of trained weights, in MLflow too, or None.
        device: ``cpu``, ``cuda``, or ``auto`` for the latter where there is one.
        works_untrained: its first weights are good for something.

    Raises:
        ConfigError: torch is missing, or there is no such device.
    """

    def __init__(
        self,
        part: HasNet,
        slot: str,
        name: str,
        make: "Callable[[], nn.Module]",
        weights: str | None,
        device: str,
        *,
        works_untrained: bool = False,
    ) -> None:
        require_torch(f"{slot}={name}")
        if device not in ("auto", "cpu", "cuda"):
            raise ConfigError(f"{slot}.device must be one of auto, cpu, cuda, got {device!r}")
        self._part = part
        self._slot = slot
        self._name = name
        self._make = make
        self._weights = weights
        self._device = device
        self._net: nn.Module | None = None
        # Whether there is a reason to believe its answers: weights, or a training in this process.
        self._taught = weights is not None or works_untrained
        self._works_untrained = works_untrained

    @property
    def net(self) -> "nn.Module":
        """Made when first asked for: torch is slow to import.

        Raises:
            ConfigError: there is no such file of weights.
            DataError: the file is of another architecture, or damaged.
        """
        if self._net is None:
            self._net = self._make().eval()
            if self._weights is not None:
                from vioframe.learning.weights import load_weights, locate_weights

                key = f"{self._slot}.weights"
                try:
                    # The file is held against the part, which has its net from here on.
                    load_weights(locate_weights(self._weights, key), self._part, key)
                except BaseException:
                    self._net = None
                    raise
        return self._net

    @property
    def needs_training(self) -> bool:
        """Without weights its answers are those of a random net."""
        return self._weights is None and not self._works_untrained

    def taught(self) -> None:
        """It is being trained in this process: nothing to warn of."""
        self._taught = True

    def prepare(self) -> "nn.Module":
        """The net on its device, for use; tells, once, of one that has learned nothing.

        Raises:
            ConfigError: a GPU or a file of weights that is not there.
            DataError: the file of weights cannot be used.
        """
        import torch

        self.net.to(self.device()).eval()
        for parameter in self.net.parameters():
            if parameter.ndim == 4:
                # In a stream of single images a convolution spends its time on weights; so they are read as they lie.
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        if not self._taught:
            log.warning(
                "%s=%s has no weights, so its answers are those of a random net: give %s.weights=FILE (task=train "
                "makes one)",
                self._slot,
                self._name,
                self._slot,
            )
            self._taught = True  # once is enough
        return self.net

    def device(self) -> "torch.device":
        """Where the net works.

        Raises:
            ConfigError: a GPU was asked for, and there is none.
        """
        import torch

        there = torch.cuda.is_available()
        if self._device == "cuda" and not there:
            raise ConfigError(
                f"{self._slot}.device=cuda, but torch finds no such GPU here: use {self._slot}.device=auto or cpu"
            )
        return torch.device("cuda" if there and self._device != "cpu" else "cpu")
