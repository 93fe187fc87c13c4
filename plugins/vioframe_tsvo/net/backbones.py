"""The temporal stream's choices, their first convolution for flow, and ImageNet files for them."""

import pickle
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from vioframe.errors import ConfigError, DataError
from vioframe_tsvo.net.googlenet import GoogLeNet
from vioframe_tsvo.net.inception import InceptionV3
from vioframe_tsvo.net.resnet import Bottleneck, ResNet50

BackboneNet = GoogLeNet | ResNet50 | InceptionV3

BACKBONES: Mapping[str, type[BackboneNet]] = {"googlenet": GoogLeNet, "resnet50": ResNet50, "inceptionv3": InceptionV3}
"""By the name that ``backbone=`` has."""


def make_backbone(name: str, channels: int, weights: Path | None = None) -> BackboneNet:
    """A backbone that ends in its pooled features.

    Args:
        name: a key of :data:`BACKBONES`.
        channels: of the input.
        weights: an ImageNet file of torchvision for this architecture, or None to start from random weights.

    Raises:
        ConfigError: no such backbone.
        DataError: the file cannot be used, see :func:`load_imagenet`.
    """
    if name not in BACKBONES:
        raise ConfigError(f"backbone.name must be one of {', '.join(BACKBONES)}, got {name!r}")
    net = BACKBONES[name](channels)
    for module in net.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        elif isinstance(module, Bottleneck):
            # Each block begins as its shortcut (Goyal et al., "Accurate, Large Minibatch SGD", 2017, section 5.1).
            nn.init.zeros_(module.bn3.weight)
    if weights is not None:
        load_imagenet(net, name, weights)
    return net


def widen(weight: Tensor, channels: int) -> Tensor:
    """First convolution (out, channels, k, k) of one for RGB (out, 3, k, k): its mean, repeated.

    The usual start of a flow stream (Wang et al., "Temporal Segment Networks", ECCV 2016, section 3.2).
    """
    return weight.mean(dim=1, keepdim=True).repeat(1, channels, 1, 1)


def load_imagenet(net: BackboneNet, name: str, path: Path) -> None:
    """Load a file of torchvision into a backbone, whatever channels its first convolution has.

    Args:
        net: the backbone; it is left as it was where the file is refused.
        name: how to call it in messages.
        path: ``.pth`` (read as data only: nothing in it is run) or ``.safetensors``.

    Raises:
        DataError: not a readable file of weights, or one of another architecture.
    """
    found = _read(path)
    own = net.state_dict()
    classifier = net.classifier_prefixes
    first = f"{net.first_convolution}.weight"
    taken = {key: value for key, value in found.items() if key in own or not key.startswith(classifier)}
    # Files written before PyTorch 0.4.1 do not count batches; the count has no use at the default momentum.
    missing = sorted(key for key in own if key not in taken and not key.endswith("num_batches_tracked"))
    unknown = sorted(key for key in taken if key not in own)
    if missing or unknown:
        what = f"it lacks {missing[0]}" if missing else f"it has {unknown[0]}"
        raise DataError(
            f"backbone.weights: {path} is not a file for {name}: {what} "
            f"({len(missing)} parameters missing, {len(unknown)} unknown)"
        )
    if taken[first].ndim == 4 and taken[first].shape[1] == 3 and own[first].shape[1] != 3:
        taken[first] = widen(taken[first], own[first].shape[1])
    for key, value in taken.items():
        if value.shape != own[key].shape:
            raise DataError(
                f"backbone.weights: {path} is not a file for {name}: {key} has shape {tuple(value.shape)}, "
                f"but {name} needs {tuple(own[key].shape)}"
            )
        if not torch.isfinite(value).all():
            raise DataError(f"backbone.weights: {path} has numbers that are not finite in {key}")
    net.load_state_dict({**own, **taken})


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise DataError(f"backbone.weights: there is no file {path}")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            found: object = load_file(path)
        else:
            found = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise DataError(
            f"backbone.weights: {path} is not a readable file of weights: it is damaged, or holds more than tensors, "
            "which could run code; fetch torchvision's own"
        ) from error
    except Exception as error:
        # A damaged or hostile file may fail anywhere in the reader, with any exception.
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DataError(f"backbone.weights: {path} is not a readable file of weights: {reason}") from error
    if not isinstance(found, dict) or not all(isinstance(value, Tensor) for value in found.values()):
        raise DataError(f"backbone.weights: {path} holds something else than named tensors")
    return {str(key): value for key, value in found.items()}
