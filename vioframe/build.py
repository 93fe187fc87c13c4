"""From a config to objects: guard the targets, check the slots, fail readably.

A config is data. What it may name are classes of vioframe, of discovered plugins and of a short list of
libraries, never a function, and in a slot only a class of the slot's interface: so no config can call
``os.system``, ``open`` or ``torch.load``.
"""

import importlib
from collections.abc import Mapping
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vioframe.data.faults import Faults
from vioframe.data.recording import Dataset
from vioframe.errors import ConfigError, PluginError, TargetError, VioframeError
from vioframe.pipeline import SLOTS, Pipeline
from vioframe.plugins import discover

T = TypeVar("T")

TRUSTED_LIBRARIES = ("torch.optim", "torch.nn", "lightning")
"""Beside vioframe and its plugins, what a ``_target_`` may name."""

OPTIONAL_SLOTS = ("frontend", "vo", "integrator")


def build(config: DictConfig, key: str, interface: type[T], choice: str = "") -> T:
    """Build the object that the config holds at ``key``.

    Args:
        config: the whole composed config.
        key: dotted path of a node with a ``_target_``.
        interface: what the object must be.
        choice: the name the user chose for it, for messages.

    Raises:
        TargetError: a ``_target_`` that a config must not name.
        PluginError: the plugin that holds it does not import.
        ConfigError: the node is missing, of the wrong interface, or the constructor refuses its values.
    """
    label = f"{key}={choice}" if choice else key
    node = OmegaConf.select(config, key)
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise ConfigError(f"{label} needs a _target_ (the class to build), but the config there is {node!r}")
    try:
        plain = OmegaConf.to_container(node, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{label}: {_first_line(error)}") from error
    return _construct(plain, key, label, interface)


def _construct(plain: Any, key: str, label: str, interface: type[T]) -> T:
    cls = resolve_class(plain["_target_"], f"{key}._target_")
    if not issubclass(cls, interface):
        raise ConfigError(
            f"{label} must be a {interface.__name__}, but {plain['_target_']} is not: choose another {key}"
        )
    arguments = {name: _construct_nested(value, f"{key}.{name}") for name, value in plain.items() if name != "_target_"}
    try:
        made: T = cls(**arguments)
    except VioframeError:
        raise
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is None:
            # The call itself did not fit the constructor; deeper ones are bugs of the plugin.
            raise ConfigError(f"{label}: {plain['_target_']} refuses its options: {_first_line(error)}") from error
        raise
    return made


def _construct_nested(value: Any, key: str) -> Any:
    if isinstance(value, dict):
        if "_target_" in value:
            return _construct(value, key, key, object)
        return {name: _construct_nested(inner, f"{key}.{name}") for name, inner in value.items()}
    if isinstance(value, list):
        return [_construct_nested(inner, f"{key}[{index}]") for index, inner in enumerate(value)]
    return value


def resolve_class(target: object, key: str) -> type:
    """The class a ``_target_`` names.

    Raises:
        TargetError: not a class of vioframe, of a discovered plugin or of a trusted library.
        PluginError: its plugin does not import.
    """
    owners = {found.package: found for found in discover()}
    allowed = (*TRUSTED_LIBRARIES, "vioframe", *owners)
    refusal = TargetError(
        f"{key}={target} is not allowed: a config may only name classes of vioframe, of its installed plugins "
        f"({', '.join(sorted(owners)) or 'none'}) or of {', '.join(TRUSTED_LIBRARIES)}"
    )
    if not isinstance(target, str) or not _lies_in(target, allowed):
        raise refusal
    module_name, _, class_name = target.rpartition(".")
    root = target.partition(".")[0]
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        # A stranger's import may raise anything; the user is told which distribution and what.
        if root in owners:
            found = owners[root]
            raise PluginError(
                f"{key}={target}: plugin {found.package} (distribution {found.distribution}, {found.folder}) "
                f"does not import: {type(error).__name__}: {_first_line(error)}"
            ) from error
        raise ConfigError(f"{key}={target} cannot be imported: {_first_line(error)}") from error
    cls = getattr(module, class_name, None)
    if cls is None:
        raise ConfigError(f"{key}={target}: module {module_name} has no {class_name}")
    # vioframe.pipeline.time.sleep lies under "vioframe" by name only: what counts is where it was defined.
    if not isinstance(cls, type) or not _lies_in(f"{cls.__module__}.{cls.__name__}", allowed):
        raise refusal
    return cls


def _lies_in(dotted: str, packages: tuple[str, ...]) -> bool:
    return any(dotted.startswith(f"{package}.") for package in packages)


def build_dataset(config: DictConfig, choice: str = "") -> Dataset:
    """Build the data set of ``config``, with the faults that are to be injected into its recordings.

    Args:
        config: with the nodes ``dataset`` and ``faults``.
        choice: the option chosen in the group ``dataset``, for messages.

    Raises:
        ConfigError: either cannot be built.
    """
    dataset = build(config, "dataset", Dataset, choice)
    return build(config, "faults", Faults).inject(dataset)


def build_pipeline(config: DictConfig, choices: Mapping[str, str]) -> Pipeline:
    """Build the five parts of ``config`` and wire them.

    Args:
        config: with a node for each slot; an empty node is an empty slot.
        choices: the option chosen in each group, such as ``{"fuser": "ekf"}``.

    Raises:
        ConfigError: a part cannot be built, or the wiring does not hold.
    """
    parts: dict[str, Any] = {}
    for slot, interface in SLOTS.items():
        node = OmegaConf.select(config, slot)
        if not node:
            if slot not in OPTIONAL_SLOTS:
                raise ConfigError(f"{slot}={choices.get(slot, 'none')} leaves the slot empty: choose a {slot}")
            continue
        parts[slot] = build(config, slot, interface, choices.get(slot, ""))
    return Pipeline(**parts, choices=choices)


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__
