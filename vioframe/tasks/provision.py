"""Weights for the parts of an experiment that have none: trained once, then found again by what they came from.

There are two stages. Parts that learn from images are trained together. A fuser that learns from what a VO answers is
trained after them, by itself: the VO is asked for the recordings once (:mod:`vioframe.tasks.answers`).

What is trained lies in ``trainer.cache/trained/<parts>-<key>``. The key is a hash of all that has a bearing on it:
the trainer's options, the configuration of the parts, the content of both splits, answers included, and the version of
this package. A training that was stopped goes on when the same command is given again.
"""

import hashlib
import json
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from vioframe.tasks.answers import read_answered_splits
from vioframe.tasks.bearing import bearing_of
from vioframe.tasks.decoding import read_splits
from vioframe.tasks.fitting import fit_parts, learns_from_answers, trainable_parts, trainer_options
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
    nets = _with_nets(pipeline)
    untrained = untrained_slots(pipeline)
    for answers in (False, True):
        slots = [slot for slot in untrained if learns_from_answers(nets[slot]) == answers]
        if slots:
            together = [slot for slot, part in nets.items() if learns_from_answers(part) == answers]
            settles = any(getattr(nets[slot], "settling_pairs", None) for slot in slots)
            _Stage(config, choices, slots, together, answers=answers, settles=settles).provide(tested, shown=shown)


def _with_nets(pipeline: Pipeline) -> dict[str, Trainable]:
    return {slot: part for slot, part in pipeline.parts().items() if isinstance(part, Trainable)}


@dataclass(frozen=True, slots=True)
class _Stage:
    """Parts that are trained together.

    Attributes:
        config: the whole; changed in place.
        choices: by group.
        slots: of the parts that need weights.
        together: of all parts that take part.
        answers: whether they learn from what a VO answers.
        settles: whether one of them is trained further by itself.
    """

    config: DictConfig
    choices: Mapping[str, str]
    slots: Sequence[str]
    together: Sequence[str]
    answers: bool
    settles: bool

    @property
    def told(self) -> str:
        """What is trained, as the user chose it."""
        return " and ".join(f"{slot}={self.choices.get(slot, '')}" for slot in self.slots)

    def provide(self, tested: Dataset, *, shown: bool) -> None:
        """Train, or find what was trained; arguments and errors as of :func:`provide_weights`."""
        require_torch(f"training {self.told}", training=True)
        options = self._options()
        read = read_answered_splits if self.answers else read_splits
        splits = read(self.config, options, self.choices, shown=shown)
        _warn_of_leak(splits, tested)
        name = "-".join(self.choices.get(slot, slot) for slot in options.train or ())
        place = Path(options.cache).expanduser() / "trained" / f"{name}-{self._key(options, splits)[:16]}"
        found = _trained(place)
        if not found:
            from filelock import FileLock

            place.mkdir(parents=True, exist_ok=True)
            # Jobs of a sweep may want the same weights: the first trains, the others wait for it.
            with FileLock(place / "lock"):
                found = _trained(place) or self._train(options, splits, place, shown=shown)
        else:
            log.info("%s was trained before: %s", self.told, place)
        for slot, file in found.items():
            OmegaConf.update(self.config, f"{slot}.weights", str(place / file))

    def _options(self) -> "TrainerOptions":
        try:
            options = trainer_options(self.config, self.choices, answers=self.answers)
        except ConfigError as error:
            given = " ".join(f"{slot}.weights=FILE" for slot in self.slots)
            raise ConfigError(
                f"{self.told} has no weights: give {given}, or have it trained first ({error})"
            ) from error
        if options.devices > 1:
            raise ConfigError(
                f"trainer.devices={options.devices}: an experiment trains {self.told} in one process; train it with "
                "task=train first, and give its weights"
            )
        if options.resume is not None:
            raise ConfigError(
                f"trainer.resume={options.resume}: an experiment goes on by itself with what it was training; use it "
                "with task=train"
            )
        if options.train is None or self.answers:
            return replace(options, train=list(self.slots))
        left = [slot for slot in self.slots if slot not in options.train]
        if left:
            raise ConfigError(
                f"trainer.train={list(options.train)} leaves {', '.join(left)} without weights: add it, or give its "
                "weights"
            )
        # What learns from answers comes after, by itself.
        return replace(options, train=[slot for slot in options.train if slot in self.together])

    def _key(self, options: "TrainerOptions", splits: "tuple[Split, Split]") -> str:
        # Other parts take no part in a training, but for what they answered, which the splits bring.
        used = {slot: bearing_of(self.config, slot) for slot in self.together}
        words = [__version__, options.settings(), used, [split.hashes for split in splits]]
        if self.settles:
            words.append(dict(options.settling or {}))
            if options.settling and options.augmentation.sensors.active:
                # What had settled before this word was there had done so with sensors in step.
                words.append("sensors out of step")
        return hashlib.sha256(json.dumps(words, sort_keys=True, default=str).encode()).hexdigest()

    def _train(
        self, options: "TrainerOptions", splits: "tuple[Split, Split]", place: Path, *, shown: bool
    ) -> dict[str, str]:
        resume = place / "resume.ckpt"
        again = resume.is_file()
        log.info("%s %s in %s", "going on to train" if again else "training", ", ".join(options.train or ()), place)
        (place / "config.yaml").write_text(OmegaConf.to_yaml(self.config, resolve=True), encoding="utf-8")
        parts = trainable_parts(self.config, self.choices, options.seed, answers=self.answers)
        with build(self.config, "tracker", Tracker, self.choices.get("tracker", "")) as tracker:
            try:
                trained = fit_parts(
                    parts,
                    splits,
                    replace(options, resume=str(resume) if again else None),
                    config=self.config,
                    choices=self.choices,
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
                f"trainer.max_minutes={options.max_minutes} ended the training before its first validation: give it "
                "more"
            )
        found = {slot: path.relative_to(place).as_posix() for slot, path in trained.weights.items()}
        partial = place / f"{_RESULT}.partial"
        partial.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        os.replace(partial, place / _RESULT)
        # It is of no more use, and three times as large as the weights.
        for spent in place.rglob(resume.name):
            spent.unlink()
        return found


def _warn_of_leak(splits: "tuple[Split, Split]", tested: Dataset) -> None:
    """Tell of recordings that are learned from, or that choose weights, and tested on as well."""
    # A stretch of a recording is called 06.0-90, the whole 06.
    learned = {sequence.name.partition(".")[0] for split in splits for sequence in split.sequences}
    both = sorted(name for name in tested.sequences if name.partition(".")[0] in learned)
    if both:
        log.warning("%s is learned from and tested on: these figures are not those of unseen data", ", ".join(both))


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
