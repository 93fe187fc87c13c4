"""Weights on disk: a safetensors file, which is data and cannot run anything, and a card beside it in JSON.

The file's own header says of which architecture it is, so that a file without its card is refused or taken just the
same. The card says where the weights come from: data, split, code, licence, and figures with their protocol.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from vioframe.errors import ConfigError, DataError
from vioframe.interfaces import HasNet

FORMAT = "vioframe-weights-1"

_SCHEMES = ("models:/", "runs:/")


def save_weights(path: Path, part: HasNet, card: Mapping[str, object]) -> None:
    """Write ``path`` (.safetensors) and its card (.json beside it); each appears whole or not at all."""
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in part.net.state_dict().items()}
    header = {"format": FORMAT, "architecture": json.dumps(dict(part.architecture), sort_keys=True)}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    # Written as bytes, so that others may read it as the umask says: the library's own file is its owner's alone.
    partial.write_bytes(save(state, metadata=header))
    os.replace(partial, path)
    document = {
        "format": FORMAT,
        "architecture": dict(part.architecture),
        "parameters": sum(parameter.numel() for parameter in part.net.parameters()),
        **card,
    }
    partial = path.with_suffix(".json.partial")
    partial.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    os.replace(partial, path.with_suffix(".json"))


def read_card(path: Path) -> dict[str, Any]:
    """The card beside a file of weights; empty where there is none.

    Raises:
        DataError: it is no JSON object.
    """
    beside = path.with_suffix(".json")
    if not beside.exists():
        return {}
    try:
        card = json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{beside} is not a card of weights ({error}): delete it, or fetch it again") from error
    if not isinstance(card, dict):
        raise DataError(f"{beside} is not a card of weights, but a {type(card).__name__}: delete it, or fetch it again")
    return card


def locate_weights(source: str, key: str) -> Path:
    """The local file that an option such as ``vo.weights`` names.

    Args:
        source: a path, or a file in MLflow: ``runs:/RUN/PATH`` or ``models:/NAME/VERSION``.
        key: the option, for messages.

    Raises:
        ConfigError: there is no such file.
    """
    if not source.startswith(_SCHEMES):
        path = Path(source).expanduser()
        if path.is_dir():
            raise ConfigError(f"{key}={source} is a folder: name one of its .safetensors files")
        if not path.is_file():
            raise ConfigError(f"{key}={source}: there is no such file; train one with task=train")
        return path
    from mlflow.artifacts import download_artifacts
    from mlflow.exceptions import MlflowException

    try:
        fetched = Path(download_artifacts(source))
    except (MlflowException, OSError) as error:
        raise ConfigError(f"{key}={source} cannot be fetched from MLflow: {_first_line(error)}") from error
    if fetched.is_file():
        return fetched
    found = sorted(fetched.rglob("*.safetensors"))
    if len(found) != 1:
        raise ConfigError(f"{key}={source} holds {len(found)} safetensors files, where one is needed: name the file")
    return found[0]


def load_weights(path: Path, part: HasNet, key: str) -> None:
    """Load a file of weights into the net of ``part``, all of it or nothing.

    Args:
        path: as :func:`locate_weights` returns it.
        part: of the architecture that the file must have.
        key: the option that names the file, for messages.

    Raises:
        DataError: truncated, not safetensors, or of another architecture, with what differs.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            _check_header(header, part, path, key)
            state = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise DataError(
            f"{key}={path} is not a whole safetensors file ({_first_line(error)}): fetch or train it again; files in "
            "other formats (.pt, .pth, .ckpt) are never opened here, since they can run code"
        ) from error
    except OSError as error:
        raise DataError(f"{key}={path} cannot be read: {error.strerror or _first_line(error)}") from error
    _check_state(state, part, path, key)
    part.net.load_state_dict(state)


def _check_header(header: Mapping[str, str], part: HasNet, path: Path, key: str) -> None:
    if header.get("format") != FORMAT:
        raise DataError(
            f"{key}={path} was not written by vioframe: its header says format={header.get('format')!r}, not {FORMAT!r}"
        )
    try:
        stored = json.loads(header.get("architecture", ""))
    except ValueError:
        stored = None
    if not isinstance(stored, dict):
        raise DataError(f"{key}={path} does not say of which architecture it is: train it again")
    wanted = dict(part.architecture)
    if stored.get("part") != wanted.get("part"):
        raise DataError(
            f"{key}={path} holds weights of {stored.get('part')!r}, not of {wanted.get('part')!r}: give the file that "
            "was trained for this part"
        )
    differing = [
        f"{name}={stored.get(name)!r} where {wanted.get(name)!r} is needed"
        for name in sorted({*stored, *wanted})
        if stored.get(name) != wanted.get(name)
    ]
    if differing:
        raise DataError(
            f"{key}={path} is of another architecture: {', '.join(differing)}; choose the options it was trained with"
        )


def _check_state(state: Mapping[str, torch.Tensor], part: HasNet, path: Path, key: str) -> None:
    own = part.net.state_dict()
    if set(state) != set(own):
        odd = sorted(set(state) ^ set(own))
        raise DataError(
            f"{key}={path} does not fit the net: {odd[0]!r} and {len(odd) - 1} others are in one of them only"
        )
    for name, tensor in state.items():
        if tensor.shape != own[name].shape:
            raise DataError(
                f"{key}={path} does not fit the net: {name} has shape {tuple(tensor.shape)} where "
                f"{tuple(own[name].shape)} is needed"
            )
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise DataError(f"{key}={path} holds values that are not finite, in {name}: fetch or train it again")


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__
