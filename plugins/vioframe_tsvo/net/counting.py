"""Size and cost of a net: what ``task=model_card`` prints.

Multiply–accumulates are those of convolutions, linear layers and LSTM layers, each counted where it is called, from
the shapes that pass; biases, activations, pooling, normalisation and element-wise products inside an LSTM cell are
not counted. FLOP, where papers mean additions and multiplications, are twice as many; most print this number.
"""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any

import torch
from torch import Tensor, nn

from vioframe.errors import ConfigError

_FREE = (nn.BatchNorm2d,)
"""Layers with parameters whose work is not counted, as said above."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """What a net weighs.

    Attributes:
        parameters: learned numbers.
        macs: multiply–accumulates of one call, with the inputs given.
        bytes: of all tensors that are saved: parameters and running statistics.
    """

    parameters: int
    macs: int
    bytes: int


def size_of(net: nn.Module, *inputs: Tensor) -> Size:
    """Parameters, multiply–accumulates and bytes of a net for these inputs.

    Quick and without memory for the weights where net and inputs are made under ``torch.device("meta")``.

    Raises:
        ConfigError: the net has a kind of layer with parameters whose work is not known here, so that a count would
            be short without saying so.
    """
    total = 0

    def add(module: nn.Module, arguments: tuple[Any, ...], output: Any) -> None:
        nonlocal total
        total += _macs(module, arguments[0], output)

    hooks = []
    for module in net.modules():
        own = list(module.parameters(recurse=False))
        if isinstance(module, (nn.Conv2d, nn.Linear, nn.LSTM)):
            hooks.append(module.register_forward_hook(add))
        elif not isinstance(module, _FREE) and any(parameter.ndim > 0 for parameter in own):
            raise ConfigError(f"multiply-accumulates of {type(module).__name__} are not known")
    training = net.training
    try:
        with torch.no_grad():
            net.eval()(*inputs)
    finally:
        net.train(training)
        for hook in hooks:
            hook.remove()
    saved = net.state_dict().values()
    return Size(
        parameters=sum(parameter.numel() for parameter in net.parameters()),
        macs=total,
        bytes=sum(tensor.numel() * tensor.element_size() for tensor in saved),
    )


def milliseconds(call: Callable[[], object], *, repeats: int = 20, device: torch.device | None = None) -> float:
    """Median wall time of a call, after two that do not count; ``device`` is waited for where it is a GPU."""
    wait = torch.cuda.synchronize if device is not None and device.type == "cuda" else _nothing
    times = []
    with torch.inference_mode():
        for _ in range(repeats + 2):
            wait()
            start = perf_counter()
            call()
            wait()
            times.append(1e3 * (perf_counter() - start))
    return median(times[2:])


def _nothing() -> None:
    """What there is to wait for on a CPU."""


def _macs(module: nn.Module, first: Tensor, output: Any) -> int:
    if isinstance(module, nn.Conv2d):
        kernel = module.kernel_size[0] * module.kernel_size[1]
        return int(output.numel()) * kernel * module.in_channels // module.groups
    if isinstance(module, nn.Linear):
        return int(output.numel()) * module.in_features
    if not isinstance(module, nn.LSTM) or module.bidirectional or module.proj_size:
        raise ConfigError(f"multiply-accumulates of this kind of {type(module).__name__} are not known")
    steps = first.numel() // module.input_size
    inner = (module.input_size + module.hidden_size) + (module.num_layers - 1) * 2 * module.hidden_size
    return steps * 4 * module.hidden_size * inner
