"""Weights for the parts of an experiment that have none: trained once, then found again by what they came from.

What is trained lies in ``trainer.cache/trained/<parts>-<key>``. The key is a hash of all that has a bearing on it:
the trainer's options, the configuration of the parts, the content of both splits and the version of this package.
A training that was stopped goes on when the same command is given again.
"""

import hashlib
import json
import logging
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from vioframe import __version__
from vioframe.build import build
from vioframe.data.recording import Dataset
from vioframe.errors import ConfigError, DataError
from vioframe.interfaces import Trainable
from vioframe.learning import require_torch
from vioframe.pipeline import Pipeline
from vioframe.tasks.decoding import read_splits
from vioframe.tasks.fitting import fit_parts, trainable_parts, trainer_options
from vioframe.tracking import Tracker

if TYPE_CHECKING:
    from vioframe.learning.options import TrainerOptions
    from vioframe.learning.training import Split

log = logging.getLogger(__name__)

_RESULT = "weights.json"


def untrained_slots(pipeline: Pipeline) -> list[str]:
    """Slots of the parts whose answers mean nothing before they are trained."""
    return [slot for slot, part in _with_nets(pipeline).items() if part.needs_training]


def provide_weights(
    config: DictConfig, choices: Mapping[str, str], pipeline: Pipeline, tested: Dataset, *, shown: bool
) -> None:
    """Fill in ``<slot>.weights`` of the parts that need training, by training them or finding what was trained before.

    Parts that work without weights, such as TVNet, are trained along only where ``trainer.train`` names them: their
    steps may cost far more than the net's.

    Args:
        config: the whole; changed in place.
        choices: by group.
        pipeline: as ``config`` describes it.
        tested: what the experiment will run on.
        shown: whether to show progress bars.

    Raises:
        ConfigError: it is not said how to train, or the training cannot work or diverges.
        DataError: recordings that cannot be learned from.
        KeyboardInterrupt: the user stopped the training; it can go on.
    """
    slots = untrained_slots(pipeline)
    told = " and ".join(f"{slot}={choices.get(slot, '')}" for slot in slots)
    require_torch(f"training {told}", training=True)
    options = _options(config, choices, slots, told)
    splits = read_splits(config, options, choices, shown=shown)
    _warn_of_leak(splits, tested)
    key = _key(config, options, _with_nets(pipeline), splits)
    name = "-".join(choices.get(slot, slot) for slot in options.train or ())
    place = Path(options.cache).expanduser() / "trained" / f"{name}-{key[:16]}"
    found = _trained(place)
    if not found:
        from filelock import FileLock

        place.mkdir(parents=True, exist_ok=True)
        # Jobs of a sweep may want the same weights: the first trains, the others wait for it.
        with FileLock(place / "lock"):
            found = _trained(place) or _train(config, choices, options, splits, place, shown=shown)
    else:
        log.info("%s was trained before: %s", told, place)
    for slot, file in found.items():
        OmegaConf.update(config, f"{slot}.weights", str(place / file))


def _with_nets(pipeline: Pipeline) -> dict[str, Trainable]:
    return {slot: part for slot, part in pipeline.parts().items() if isinstance(part, Trainable)}


def _options(config: DictConfig, choices: Mapping[str, str], slots: list[str], told: str) -> "TrainerOptions":
    """The trainer's options, for ``slots``."""
    try:
        options = trainer_options(config, choices)
    except ConfigError as error:
        given = " ".join(f"{slot}.weights=FILE" for slot in slots)
        raise ConfigError(f"{told} has no weights: give {given}, or have it trained first ({error})") from error
    if options.devices > 1:
        raise ConfigError(
            f"trainer.devices={options.devices}: an experiment trains {told} in one process; train it with task=train "
            "first, and give its weights"
        )
    if options.resume is not None:
        raise ConfigError(
            f"trainer.resume={options.resume}: an experiment goes on by itself with what it was training; use it with "
            "task=train"
        )
    left = [slot for slot in slots if options.train is not None and slot not in options.train]
    if left:
        raise ConfigError(
            f"trainer.train={list(options.train or ())} leaves {', '.join(left)} without weights: add it, or give its "
            "weights"
        )
    return options if options.train is not None else replace(options, train=slots)


def _warn_of_leak(splits: "tuple[Split, Split]", tested: Dataset) -> None:
    """Tell of recordings that are learned from, or that choose weights, and tested on as well."""
    # A stretch of a recording is called 06.0-90, the whole 06.
    learned = {sequence.name.partition(".")[0] for split in splits for sequence in split.sequences}
    both = sorted(name for name in tested.sequences if name.partition(".")[0] in learned)
    if both:
        log.warning("%s is learned from and tested on: these figures are not those of unseen data", ", ".join(both))


def _key(
    config: DictConfig, options: "TrainerOptions", parts: Mapping[str, Trainable], splits: "tuple[Split, Split]"
) -> str:
    # Parts without a net take no part in a training.
    used = {slot: _bearing(OmegaConf.to_container(config[slot], resolve=True)) for slot in parts}
    words = [__version__, options.settings(), used, [split.hashes for split in splits]]
    return hashlib.sha256(json.dumps(words, sort_keys=True, default=str).encode()).hexdigest()


def _bearing(node: object) -> object:
    """What of a part's options has a bearing on what it learns: of files it starts from the content, not the name."""
    if not isinstance(node, dict):
        return node
    kept = {name: _bearing(value) for name, value in node.items() if name not in ("device", "cache")}
    source = kept.get("weights")
    if isinstance(source, str) and Path(source).expanduser().is_file():
        with Path(source).expanduser().open("rb") as file:
            kept["weights"] = hashlib.file_digest(file, "sha256").hexdigest()
    return kept


def _trained(place: Path) -> dict[str, str]:
    """File names by slot of a training that ended, or nothing."""
    try:
        found: dict[str, str] = json.loads((place / _RESULT).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise DataError(
            f"{place / _RESULT} is damaged ({error}): delete the folder, and it is trained again"
        ) from error
    return found if all((place / name).is_file() for name in found.values()) else {}


def _train(
    config: DictConfig,
    choices: Mapping[str, str],
    options: "TrainerOptions",
    splits: "tuple[Split, Split]",
    place: Path,
    *,
    shown: bool,
) -> dict[str, str]:
    resume = place / "resume.ckpt"
    again = resume.is_file()
    log.info("%s %s in %s", "going on to train" if again else "training", ", ".join(options.train or ()), place)
    (place / "config.yaml").write_text(OmegaConf.to_yaml(config, resolve=True), encoding="utf-8")
    parts = trainable_parts(config, choices, options.seed)
    with build(config, "tracker", Tracker, choices.get("tracker", "")) as tracker:
        try:
            trained = fit_parts(
                parts,
                splits,
                replace(options, resume=str(resume) if again else None),
                config=config,
                choices=choices,
                folder=place,
                tracker=tracker,
                shown=shown,
            )
        except KeyboardInterrupt:
            log.warning("training was interrupted; the same command goes on with it")
            tracker.finish("killed", "interrupted by the user")
            raise
    if not trained.weights:
        raise ConfigError(
            f"trainer.max_minutes={options.max_minutes} ended the training before its first validation: give it more"
        )
    found = {slot: path.relative_to(place).as_posix() for slot, path in trained.weights.items()}
    partial = place / f"{_RESULT}.partial"
    partial.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    os.replace(partial, place / _RESULT)
    # It is of no more use, and three times as large as the weights.
    resume.unlink(missing_ok=True)
    return found
