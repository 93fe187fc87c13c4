"""Size and cost of a net: what ``task=model_card`` prints.

Multiply–accumulates are those of convolutions, linear layers and LSTM layers, each counted where it is called, from
the shapes that pass; biases, activations, pooling, normalisation and element-wise products inside an LSTM cell are
not counted. FLOP, where papers mean additions and multiplications, are twice as many; most print this number.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import torch
from torch import Tensor, nn

from vioframe.errors import ConfigError

_FREE = (nn.BatchNorm1d, nn.BatchNorm2d, nn.LayerNorm, nn.GroupNorm)
"""Layers with parameters whose work is not counted, as said above."""


@dataclass(slots=True, kw_only=True)
class Work:
    """What was done while it was counted.

    Attributes:
        macs: multiply–accumulates.
        uncounted: kinds of layers with weights whose work is not known here, so that ``macs`` is short of it.
    """

    macs: int = 0
    uncounted: set[str] = field(default_factory=set)


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """What a net weighs.

    Attributes:
        parameters: learned numbers.
        bytes: of all tensors that are saved: parameters and running statistics.
        macs: multiply–accumulates of one call, with the inputs given.
    """

    parameters: int
    bytes: int
    macs: int


@contextmanager
def counting(net: nn.Module) -> Iterator[Work]:
    """Count the work of every call of the net's layers inside the block."""
    work = Work()

    def add(module: nn.Module, arguments: tuple[Any, ...], output: Any) -> None:
        work.macs += _macs(module, arguments[0], output)

    hooks = []
    for module in net.modules():
        if _is_counted(module):
            hooks.append(module.register_forward_hook(add))
        elif not isinstance(module, _FREE) and any(each.ndim > 0 for each in module.parameters(recurse=False)):
            work.uncounted.add(type(module).__name__)
    try:
        yield work
    finally:
        for hook in hooks:
            hook.remove()


@contextmanager
def idling(net: nn.Module) -> Iterator[None]:
    """Let the counted layers answer zeros of the right shape inside the block, which costs next to nothing."""
    idle = [module for module in net.modules() if _is_counted(module)]
    for module in idle:
        module.forward = partial(_zeros, module)
    try:
        yield
    finally:
        for module in idle:
            del module.forward


def size_of(net: nn.Module, *inputs: Tensor) -> Size:
    """Parameters, bytes and multiply–accumulates of a net for these inputs.

    Quick and without memory for the weights where net and inputs are made under ``torch.device("meta")``.

    Raises:
        ConfigError: the net has a kind of layer whose work is not known here, so that a count would be short
            without saying so.
    """
    training = net.training
    try:
        with torch.no_grad(), counting(net) as work:
            net.eval()(*inputs)
    finally:
        net.train(training)
    if work.uncounted:
        raise ConfigError(f"multiply-accumulates of {', '.join(sorted(work.uncounted))} are not known")
    return Size(parameters=parameters_of(net), bytes=bytes_of(net), macs=work.macs)


def parameters_of(net: nn.Module) -> int:
    """Learned numbers."""
    return sum(parameter.numel() for parameter in net.parameters())


def bytes_of(net: nn.Module) -> int:
    """Size of all tensors that are saved."""
    return sum(tensor.numel() * tensor.element_size() for tensor in net.state_dict().values())


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


def _is_counted(module: nn.Module) -> bool:
    if isinstance(module, nn.LSTM):
        return not module.bidirectional and not module.proj_size
    return isinstance(module, (nn.Conv1d, nn.Conv2d, nn.Linear))


def _zeros(module: nn.Module, first: Tensor, *rest: Any) -> Any:
    """What a counted layer would answer, as zeros."""
    if isinstance(module, nn.Linear):
        return first.new_zeros(*first.shape[:-1], module.out_features)
    if isinstance(module, (nn.Conv1d, nn.Conv2d)):
        axes = len(module.kernel_size)
        return first.new_zeros(*first.shape[: -axes - 1], module.out_channels, *_sides(module, first.shape[-axes:]))
    if not isinstance(module, nn.LSTM):
        raise TypeError(f"{type(module).__name__} is not counted")
    batch = first.shape[:0] if first.ndim == 2 else first.shape[0 if module.batch_first else 1 :][:1]
    memory = first.new_zeros(module.num_layers, *batch, module.hidden_size)
    return first.new_zeros(*first.shape[:-1], module.hidden_size), (memory, memory.clone())


def _sides(module: nn.Conv1d | nn.Conv2d, sides: Sequence[int]) -> list[int]:
    """Height and width (or length) of what a convolution makes of an input of these."""
    if module.padding == "same":
        return list(sides)
    padding = [0] * len(sides) if isinstance(module.padding, str) else list(module.padding)
    shape = zip(sides, padding, module.kernel_size, module.dilation, module.stride, strict=True)
    return [(side + 2 * pad - reach * (kernel - 1) - 1) // step + 1 for side, pad, kernel, reach, step in shape]


def _macs(module: nn.Module, first: Tensor, output: Any) -> int:
    if isinstance(module, (nn.Conv1d, nn.Conv2d)):
        kernel = module.weight[0, 0].numel()
        return int(output.numel()) * kernel * module.in_channels // module.groups
    if isinstance(module, nn.Linear):
        return int(output.numel()) * module.in_features
    if not isinstance(module, nn.LSTM):
        raise TypeError(f"{type(module).__name__} is not counted")
    steps = first.numel() // module.input_size
    inner = (module.input_size + module.hidden_size) + (module.num_layers - 1) * 2 * module.hidden_size
    return steps * 4 * module.hidden_size * inner
