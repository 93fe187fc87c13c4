"""``task=train``: train the parts that have a net, together, and keep the weights that do best in validation.

A fuser that learns from what a VO answers is trained by itself, and the VO has to know its answers by then. A part may
bring a training of its own.
"""

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from vioframe.build import build, build_pipeline
from vioframe.errors import ConfigError, DataError
from vioframe.interfaces import Trainable, TrainsItself
from vioframe.learning import require_torch
from vioframe.tasks.answers import read_answered_splits
from vioframe.tasks.decoding import read_splits
from vioframe.tasks.fitting import fit_parts, learns_from_answers, trainable_parts, trainer_options
from vioframe.tasks.interruption import INTERRUPTED, terminate_like_interrupt
from vioframe.tracking import NullTracker, Tracker

log = logging.getLogger(__name__)

RESUME_FILE = "resume.ckpt"
"""What a training writes to be gone on with, in its folder."""


def run(config: DictConfig) -> int:
    """Train what ``config`` describes; return the exit status, 130 after Ctrl-C."""
    require_torch("task=train", training=True)
    hydra_config = HydraConfig.get()
    choices = {group: str(option) for group, option in hydra_config.runtime.choices.items()}
    # With trainer.devices=2 lightning starts this command again for each further process; one speaks for all.
    follows = int(os.environ.get("LOCAL_RANK", "0")) > 0
    shown = bool(config.progress) and hydra_config.mode != RunMode.MULTIRUN and not follows
    themselves = _train_themselves(config, choices)
    if themselves:
        return _run_own(themselves, config, choices, shown=shown)
    answers = _learns_from_answers(config, choices)
    options = trainer_options(config, choices, answers=answers)
    if options.resume is not None and not Path(options.resume).expanduser().is_file():
        raise DataError(f"trainer.resume={options.resume}: there is no such file; a run writes resume.ckpt each epoch")
    parts = trainable_parts(config, choices, options.seed, answers=answers)
    # A run that goes on goes on where it was: its weights and its curve are there.
    output = Path(hydra_config.runtime.output_dir)
    folder = output if options.resume is None else Path(options.resume).expanduser().parent
    tracker = NullTracker() if follows else build(config, "tracker", Tracker, choices.get("tracker", ""))
    output.mkdir(parents=True, exist_ok=True)
    (output / "config.yaml").write_text(OmegaConf.to_yaml(config, resolve=True), encoding="utf-8")
    with terminate_like_interrupt(), tracker:
        splits = (read_answered_splits if answers else read_splits)(config, options, choices, shown=shown)
        try:
            trained = fit_parts(
                parts, splits, options, config=config, choices=choices, folder=folder, tracker=tracker, shown=shown
            )
        except KeyboardInterrupt:
            resume = folder / "resume.ckpt"
            log.warning(
                "interrupted; %s", f"go on with trainer.resume={resume}" if resume.exists() else "no epoch was complete"
            )
            tracker.finish("killed", "interrupted by the user")
            return INTERRUPTED
        if follows:
            return 0
        if (output / "config.yaml").exists():
            tracker.log_file(output / "config.yaml")
        if not trained.weights:
            sentence = f"no validation was reached in {trained.epochs} epochs, so no weights were kept"
            log.error("%s; %s", sentence, folder)
            tracker.finish("failed", sentence)
            return 1
        for slot, path in trained.weights.items():
            log.info("weights of %s: %s (use them with %s.weights=...)", slot, path, slot)
    return 0


def _train_themselves(config: DictConfig, choices: Mapping[str, str]) -> dict[str, TrainsItself]:
    """The parts to train that have a training of their own, by slot.

    Raises:
        ConfigError: there are others beside them, which are trained otherwise.
    """
    parts = build_pipeline(config, choices).parts()
    chosen = OmegaConf.select(config, "trainer.train")
    wanted = {slot: part for slot, part in parts.items() if chosen is None or slot in chosen}
    own: dict[str, TrainsItself] = {slot: part for slot, part in wanted.items() if isinstance(part, TrainsItself)}
    others = [slot for slot, part in wanted.items() if isinstance(part, Trainable) and slot not in own]
    if own and others:
        first, second = next(iter(own)), others[0]
        raise ConfigError(
            f"{first}={choices.get(first, '')} has a training of its own, {second}={choices.get(second, '')} has not: "
            f"train one after the other, with trainer.train=[{first}] and trainer.train=[{second}]"
        )
    return own


def _run_own(parts: Mapping[str, TrainsItself], config: DictConfig, choices: Mapping[str, str], *, shown: bool) -> int:
    """Train parts by their own trainings, one after the other; the exit status."""
    hydra_config = HydraConfig.get()
    check_own_training(hydra_config.overrides.task, {slot: choices.get(slot, "") for slot in parts})
    resume = OmegaConf.select(config, "trainer.resume")
    output = Path(hydra_config.runtime.output_dir)
    folder = output if resume is None else folder_to_resume(str(resume))
    tracker = build(config, "tracker", Tracker, choices.get("tracker", ""))
    output.mkdir(parents=True, exist_ok=True)
    (output / "config.yaml").write_text(OmegaConf.to_yaml(config, resolve=True), encoding="utf-8")
    plain = OmegaConf.to_container(config, resolve=True)
    parameters = {str(key): value for key, value in plain.items()} if isinstance(plain, dict) else {}
    chosen = {slot: choices.get(slot, "none") for slot in parts}
    weights: dict[str, Path] = {}
    with terminate_like_interrupt(), tracker:
        tracker.start(parameters, {"task": "train", **chosen}, name=f"train {' '.join(chosen.values())}")
        try:
            for slot, part in parts.items():
                weights |= part.train_itself(
                    folder if len(parts) == 1 else folder / slot, tracker, shown=shown, resume=resume is not None
                )
        except KeyboardInterrupt:
            log.warning("interrupted; %s", _how_to_go_on(folder))
            tracker.finish("killed", "interrupted by the user")
            return INTERRUPTED
        tracker.log_file(output / "config.yaml")
        for slot, path in weights.items():
            tracker.log_file(path, "weights")
            tracker.log_file(path.with_suffix(".json"), "weights")
            log.info("weights of %s: %s (use them with %s.weights=...)", slot, path, slot)
        if len(weights) < len(parts):
            log.warning("it ended before there were weights; %s", _how_to_go_on(folder))
    return 0


def check_own_training(overrides: Sequence[str], parts: Mapping[str, str]) -> None:
    """Refuse what says how parts are trained on recordings, where they have a training of their own.

    Args:
        overrides: of the command line.
        parts: that have, as they were chosen, by slot.

    Raises:
        ConfigError: with the first that would do nothing.
    """
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        group = key.partition(".")[0].partition("@")[0]
        if group in ("trainer", "training_data") and key not in ("trainer.train", "trainer.resume"):
            slot, choice = next(iter(parts.items()))
            raise ConfigError(
                f"{override} would do nothing: {slot}={choice} has a training of its own, of trainer it reads train "
                f"and resume alone; its options are those of {slot} (task=train {slot}={choice} --cfg job shows them)"
            )


def folder_to_resume(resume: str) -> Path:
    """The folder of a training of its own that ``trainer.resume`` names by its file.

    Raises:
        DataError: there is none.
    """
    path = Path(resume).expanduser()
    if path.name != RESUME_FILE:
        raise DataError(f"trainer.resume={resume}: give the {RESUME_FILE} of the folder of a training")
    if not path.is_file():
        raise DataError(f"trainer.resume={resume}: there is no {RESUME_FILE} in {path.parent}")
    return path.parent


def _how_to_go_on(folder: Path) -> str:
    resume = folder / RESUME_FILE
    return f"go on with trainer.resume={resume}" if resume.exists() else "there is nothing to go on from yet"


def _learns_from_answers(config: DictConfig, choices: Mapping[str, str]) -> bool:
    """Whether it is the fuser that is to be trained, on what the VO answers.

    Raises:
        ConfigError: the VO has no weights yet, so it cannot be asked.
    """
    nets = {slot: part for slot, part in build_pipeline(config, choices).parts().items() if isinstance(part, Trainable)}
    later = [slot for slot, part in nets.items() if learns_from_answers(part)]
    chosen = OmegaConf.select(config, "trainer.train")
    if not later or (chosen is not None and not set(chosen) & set(later)):
        return False
    untaught = [slot for slot, part in nets.items() if slot not in later and part.needs_training]
    if untaught:
        told, before = (
            " and ".join(f"{slot}={choices.get(slot, '')}" for slot in slots) for slots in (later, untaught)
        )
        first = ",".join(untaught)
        raise ConfigError(
            f"{told} learns from what {before} answers, which has no weights: train it first (trainer.train=[{first}]) "
            f"and give {untaught[0]}.weights=FILE, or run the experiment (task=experiment), which does both"
        )
    return True
