"""From a config to trained weights: the parts that have a net, how they are trained, and the record of it."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from vioframe.build import build, build_pipeline
from vioframe.errors import ConfigError
from vioframe.interfaces import Trainable
from vioframe.tracking import Tracker

if TYPE_CHECKING:
    from vioframe.learning.options import TrainerOptions
    from vioframe.learning.training import Split, Trained

log = logging.getLogger(__name__)


def trainer_options(config: DictConfig, choices: Mapping[str, str], *, answers: bool = False) -> "TrainerOptions":
    """The options of ``trainer=``.

    Args:
        config: the whole.
        choices: by group, for messages.
        answers: whether a fuser is to be trained on what a VO answered, as ``trainer.fusion`` says.

    Raises:
        ConfigError: no trainer or no training data was chosen, or an option that cannot work.
    """
    from vioframe.learning.options import TrainerOptions

    for group, example in (("trainer", "cpu"), ("training_data", "simulated_car")):
        if not config.get(group):
            raise ConfigError(f"{group}={choices.get(group, 'none')} does not say how to train: add {group}={example}")
    if answers:
        plain = OmegaConf.create({"trainer": OmegaConf.to_container(config.trainer, resolve=True)})
        plain.trainer = OmegaConf.merge(plain.trainer, plain.trainer.fusion)
        config = plain
    return build(config, "trainer", TrainerOptions, choices.get("trainer", ""))


def learns_from_answers(part: Trainable) -> bool:
    """Whether a part is trained by itself, on what the parts before it answered; see :class:`Trainable`."""
    return getattr(part, "learns_from", "images") == "answers"


def trainable_parts(
    config: DictConfig, choices: Mapping[str, str], seed: int, *, answers: bool = False
) -> dict[str, Trainable]:
    """The parts of ``config`` that have a net and are trained together, by slot, in the order of the pipeline.

    Args:
        config: the whole.
        choices: by group, for messages.
        seed: of their first weights.
        answers: take those that learn from what a VO answered, else those that learn from images.

    Raises:
        ConfigError: there is none, or the parts do not fit together.
    """
    from vioframe.learning.seeding import seed_everything

    seed_everything(seed)
    filled = build_pipeline(config, choices).parts()
    parts: dict[str, Trainable] = {
        slot: part
        for slot, part in filled.items()
        if isinstance(part, Trainable) and learns_from_answers(part) == answers
    }
    if not parts:
        told = ", ".join(f"{slot}={choices.get(slot, '')}" for slot in filled)
        raise ConfigError(f"task=train has nothing to train: none of {told} has a net; choose a part that has one")
    return parts


def fit_parts(
    parts: Mapping[str, Trainable],
    splits: "tuple[Split, Split]",
    options: "TrainerOptions",
    *,
    config: DictConfig,
    choices: Mapping[str, str],
    folder: Path,
    tracker: Tracker,
    shown: bool,
) -> "Trained":
    """Train ``parts`` in a record of its own, and tell what came out.

    Args:
        parts: by slot, as :func:`trainable_parts` returns them.
        splits: training and validation, as :func:`read_splits` returns them.
        options: of the training.
        config: the whole, for the record and the card.
        choices: by group.
        folder: of weights, curve and resume file.
        tracker: not started; whoever calls finishes it.
        shown: whether to show a progress bar.

    Raises:
        ConfigError: an option that cannot work, or a learning rate that diverges.
        DataError: recordings that are too short, or a resume file that does not fit.
        KeyboardInterrupt: the user stopped it; weights and resume file are those of the last epoch.
    """
    # Lightning takes its seconds only now that the user's mistakes are told.
    from vioframe.learning.training import has_gpu, train_parts

    if options.accelerator == "cpu" and has_gpu():
        log.info("trainer=%s leaves the GPU of this machine idle; trainer=default uses it", choices.get("trainer", ""))
    plain = OmegaConf.to_container(config, resolve=True)
    parameters = {str(key): value for key, value in plain.items()} if isinstance(plain, dict) else {}
    chosen = {slot: choices.get(slot, "none") for slot in parts}
    about = {"parts": chosen, "config": {slot: parameters.get(slot) for slot in parts}}
    tags = {"task": "train", "training_data": choices.get("training_data", ""), **chosen}
    tracker.start(parameters, tags, name=f"train {' '.join(chosen.values())}")
    trained = train_parts(parts, *splits, options, folder=folder, tracker=tracker, about=about, shown=shown)
    if trained.score is not None:
        log.info(
            "best of %d epochs on the validation recordings: t_rel %.2f %%, r_rel %.2f °/100 m (%s: "
            "%.2f %%, %.2f °/100 m; %d segments)",
            trained.epochs,
            trained.score.t_rel_percent,
            trained.score.r_rel_deg_per_100m,
            trained.beside,
            trained.reference.t_rel_percent,
            trained.reference.r_rel_deg_per_100m,
            trained.score.segments,
        )
    for path in trained.weights.values():
        tracker.log_file(path, "weights")
        tracker.log_file(path.with_suffix(".json"), "weights")
    if (folder / "curve.csv").exists():
        tracker.log_file(folder / "curve.csv")
    return trained
