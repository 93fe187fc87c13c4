"""``task=train``: train the parts that have a net, together, and keep the weights that do best in validation."""

import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from vioframe.build import build, build_pipeline
from vioframe.data.recording import Dataset
from vioframe.data.sequence_cache import SequenceCache
from vioframe.data.windows import check_split
from vioframe.errors import ConfigError
from vioframe.interfaces import Trainable
from vioframe.learning import require_torch
from vioframe.tasks.interruption import INTERRUPTED, terminate_like_interrupt
from vioframe.tasks.progress import frame_progress
from vioframe.tracking import NullTracker, Tracker

if TYPE_CHECKING:
    from vioframe.learning.options import TrainerOptions
    from vioframe.learning.training import Split, Trained

log = logging.getLogger(__name__)

_SPLITS = ("train", "validation")


def run(config: DictConfig) -> int:
    """Train what ``config`` describes; return the exit status, 130 after Ctrl-C."""
    require_torch("task=train", training=True)
    from vioframe.learning.options import TrainerOptions
    from vioframe.learning.seeding import seed_everything

    hydra_config = HydraConfig.get()
    choices = {group: str(option) for group, option in hydra_config.runtime.choices.items()}
    # With trainer.devices=2 lightning starts this command again for each further process; one speaks for all.
    follows = int(os.environ.get("LOCAL_RANK", "0")) > 0
    shown = bool(config.progress) and hydra_config.mode != RunMode.MULTIRUN and not follows
    options = build(config, "trainer", TrainerOptions, choices.get("trainer", ""))
    # Before the parts are built: their first weights are drawn then.
    seed_everything(options.seed)
    parts = trainable_parts(config, choices)
    # Lightning takes its seconds only now that the user's mistakes are told.
    from vioframe.learning.training import train_parts

    # A run that goes on goes on where it was: its weights and its curve are there.
    output = Path(hydra_config.runtime.output_dir)
    folder = output if options.resume is None else Path(options.resume).expanduser().parent
    tracker = NullTracker() if follows else build(config, "tracker", Tracker, choices.get("tracker", ""))
    plain = OmegaConf.to_container(config, resolve=True)
    parameters = {str(key): value for key, value in plain.items()} if isinstance(plain, dict) else {}
    about = {"parts": {slot: choices.get(slot, "none") for slot in parts}, "config": _part_configs(parameters, parts)}
    output.mkdir(parents=True, exist_ok=True)
    (output / "config.yaml").write_text(OmegaConf.to_yaml(config, resolve=True), encoding="utf-8")
    with terminate_like_interrupt(), tracker:
        training, validation = read_splits(config, options, choices, shown=shown)
        tags = {"task": "train", "training_data": choices.get("training_data", ""), **_tags(parts, choices)}
        tracker.start(parameters, tags, name=f"train {' '.join(choices.get(slot, slot) for slot in parts)}")
        try:
            trained = train_parts(
                parts, training, validation, options, folder=folder, tracker=tracker, about=about, shown=shown
            )
        except KeyboardInterrupt:
            log.warning("interrupted; go on with trainer.resume=%s", folder / "resume.ckpt")
            tracker.finish("killed", "interrupted by the user")
            return INTERRUPTED
        if follows:
            return 0
        _tell(trained, folder)
        for path in (*trained.weights.values(), *(path.with_suffix(".json") for path in trained.weights.values())):
            tracker.log_file(path, "weights")
        for name in ("config.yaml", "curve.csv"):
            if (folder / name).exists():
                tracker.log_file(folder / name)
    return 0


def trainable_parts(config: DictConfig, choices: Mapping[str, str]) -> dict[str, Trainable]:
    """The parts of ``config`` that have a net, by slot, in the order of the pipeline.

    Raises:
        ConfigError: there is none, or the parts do not fit together.
    """
    filled = build_pipeline(config, choices).parts()
    parts: dict[str, Trainable] = {slot: part for slot, part in filled.items() if isinstance(part, Trainable)}
    if not parts:
        told = ", ".join(f"{slot}={choices.get(slot, '')}" for slot in filled)
        raise ConfigError(f"task=train has nothing to train: none of {told} has a net; choose a part that has one")
    return parts


def read_splits(
    config: DictConfig, options: "TrainerOptions", choices: Mapping[str, str], *, shown: bool
) -> "tuple[Split, Split]":
    """Decode the recordings of ``training_data``, or find them decoded.

    Args:
        config: with ``training_data.train`` and ``training_data.validation``, each a data set.
        options: size and place of what is decoded.
        choices: by group, for messages.
        shown: whether to show a progress bar.

    Raises:
        ConfigError: a recording of both splits.
        DataError: a recording that cannot be read or stored.
    """
    from vioframe.learning.training import Split

    width, height = (int(size) for size in options.size_px) if len(options.size_px) == 2 else (0, 0)
    cache = SequenceCache(
        Path(options.cache).expanduser() / "recordings", size_px=(width, height), channels=options.channels
    )
    datasets = {split: build(config, f"training_data.{split}", Dataset) for split in _SPLITS}
    check_split(datasets["train"].sequences, datasets["validation"].sequences)
    splits = []
    for split, dataset in datasets.items():
        source = OmegaConf.to_yaml(config.training_data[split], resolve=True, sort_keys=True)
        found = []
        for name in dataset.sequences:
            recording = dataset.open(name)
            with frame_progress(f"decoding {name}", recording.frame_count + 1, shown=shown) as advance:
                found.append(cache.get(recording, source, advance))
        splits.append(Split(sequences=tuple(one for one, _ in found), hashes=tuple(content for _, content in found)))
    return splits[0], splits[1]


def _tags(parts: Mapping[str, Trainable], choices: Mapping[str, str]) -> dict[str, str]:
    return {slot: choices.get(slot, "none") for slot in parts}


def _part_configs(parameters: Mapping[str, object], parts: Mapping[str, Trainable]) -> dict[str, object]:
    return {slot: parameters.get(slot) for slot in parts}


def _tell(trained: "Trained", folder: Path) -> None:
    if trained.score is None:
        log.warning("no validation was reached in %d epochs, so no weights were kept; %s", trained.epochs, folder)
        return
    log.info(
        "best of %d epochs on the validation recordings: t_rel %.2f %%, r_rel %.2f °/100 m (constant motion: %.2f %%, "
        "%.2f °/100 m; %d segments)",
        trained.epochs,
        trained.score.t_rel_percent,
        trained.score.r_rel_deg_per_100m,
        trained.constant.t_rel_percent,
        trained.constant.r_rel_deg_per_100m,
        trained.score.segments,
    )
    for slot, path in trained.weights.items():
        log.info("weights of %s: %s (use them with %s.weights=...)", slot, path, slot)
