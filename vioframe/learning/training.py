"""From parts and recordings to weights: one call."""

import hashlib
import json
import logging
import math
import pickle
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.accelerators import CUDAAccelerator
from lightning.pytorch.callbacks import Callback

from vioframe import __version__
from vioframe.data.windows import StoredSequence, WindowIndex
from vioframe.errors import DataError
from vioframe.interfaces import Trainable
from vioframe.learning.callbacks import (
    Bar,
    BestPicture,
    BestWeights,
    Curve,
    CurvePicture,
    FlowPicture,
    ResumePoint,
    Row,
    StopDivergence,
)
from vioframe.learning.datamodule import WindowData
from vioframe.learning.module import TrainingModule
from vioframe.learning.options import TrainerOptions
from vioframe.learning.running import quiet, running, told
from vioframe.learning.scoring import Score, mean_motion, score_motions
from vioframe.learning.seeding import seed_everything
from vioframe.learning.settling import FOLDER as SETTLED
from vioframe.learning.settling import fingerprint, resume_file, settling_options
from vioframe.learning.weights import load_weights, read_card
from vioframe.tracking import Tracker

log = logging.getLogger(__name__)

# Pairs by which windows of validation are longer than those of training.
_FURTHER_PAIRS = 7

_PROTOCOL = (
    "trajectory of camera 0, causal, no alignment; mean over segments of the given lengths; validation recordings, "
    "which also chose these weights"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Split:
    """Recordings of one purpose.

    Attributes:
        sequences: decoded.
        hashes: of the content of each.
    """

    sequences: tuple[StoredSequence, ...]
    hashes: tuple[str, ...]

    def about(self) -> list[dict[str, object]]:
        """For the card."""
        pairs = zip(self.sequences, self.hashes, strict=True)
        return [{"name": one.name, "images": len(one), "sha256": content} for one, content in pairs]


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """What came out.

    Attributes:
        weights: file of the best weights, by slot; empty if no validation was reached.
        score: of the best, on the validation recordings.
        reference: of what stands beside it, on the same recordings.
        beside: what that is: ``constant motion``, or ``the VO alone``.
        epochs: that were completed, those of a resumed run included.
        curve: one row an epoch.
    """

    weights: Mapping[str, Path]
    score: Score | None
    reference: Score
    beside: str
    epochs: int
    curve: Sequence[Row]


def train_parts(
    parts: Mapping[str, Trainable],
    training: Split,
    validation: Split,
    options: TrainerOptions,
    *,
    folder: Path,
    tracker: Tracker,
    about: Mapping[str, object],
    shown: bool,
) -> Trained:
    """Train the parts together, then those that wish it on longer windows, and leave each with its best weights.

    Args:
        parts: by slot, in the order of the pipeline.
        training, validation: recordings.
        options: of the training.
        folder: of weights, curve and resume file.
        tracker: that records the curve.
        about: what the card should say of how the parts were configured.
        shown: whether to show a progress bar.

    Raises:
        ConfigError: an option that cannot work, or a learning rate that diverges.
        DataError: recordings that are too short, or a resume file that does not fit.
        KeyboardInterrupt: the user stopped it; weights and resume file are those of the last epoch.
    """
    pairs = options.pairs or max(getattr(part, "training_pairs", None) or part.context_pairs for part in parts.values())
    first = _train_together(
        parts, training, validation, options, pairs, folder=folder, tracker=tracker, about=about, shown=shown
    )
    further = settling_options(
        parts, list(first.weights), training.sequences, validation.sequences, options, pairs=pairs
    )
    if further is None:
        return first
    if first.epochs < options.max_epochs:
        # It would settle on weights that are not final: those that a resumed run goes on to train.
        log.warning(
            "trainer.max_minutes=%s ended the training after %d of trainer.max_epochs=%d epochs: %s is not settled; "
            "task=train with trainer.resume and more time goes on to it",
            options.max_minutes,
            first.epochs,
            options.max_epochs,
            ", ".join(further.train or ()),
        )
        return first
    place, start = folder / SETTLED, fingerprint(parts)
    resume = None if options.resume is None else resume_file(place, start)
    if resume is None:
        # What is left there settled on other weights.
        shutil.rmtree(place / "weights", ignore_errors=True)
    settled = _train_together(
        parts,
        training,
        validation,
        replace(further, resume=resume),
        further.pairs or pairs,
        folder=place,
        tracker=tracker,
        about=about,
        shown=shown,
        start=start,
    )
    if not settled.weights:
        log.info("no epoch of settling was better than what it began with, which is kept")
        _load(parts, {slot: first.weights[slot] for slot in further.train or ()})
    return replace(
        settled if settled.weights else first,
        weights={**first.weights, **settled.weights},
        epochs=first.epochs + settled.epochs,
        curve=[*first.curve, *settled.curve],
    )


def _train_together(
    parts: Mapping[str, Trainable],
    training: Split,
    validation: Split,
    options: TrainerOptions,
    pairs: int,
    *,
    folder: Path,
    tracker: Tracker,
    about: Mapping[str, object],
    shown: bool,
    start: str | None = None,
) -> Trained:
    """One stage, on windows of ``pairs`` pairs; arguments and errors as of :func:`train_parts`.

    Where ``start`` tells which weights it begins with, only better ones come out.
    """
    context = max(part.context_pairs for part in parts.values())
    if pairs < context:
        log.warning("trainer.pairs=%d is less than the %d pairs that one answer takes, which are taken", pairs, context)
    train_index = WindowIndex(training.sequences, max(pairs, context), split="training")
    validation_index = _validation_windows(validation.sequences, max(pairs, context))
    beside, reference = _reference(training, validation_index, context, options)
    seed_everything(options.seed)
    module = TrainingModule(parts, options, validation.sequences, reference)
    data = WindowData(
        train_index,
        validation_index.tiled(validation_index.pairs - context + 1),
        augmentation=options.augmentation,
        batch_size=options.batch_size,
        epoch_windows=options.epoch_windows,
        seed=options.seed,
        workers=options.workers,
    )
    base = _card(training, validation, options, {**about, "reference": {"what": beside, **asdict(reference)}})
    # A part without weights, such as a classical flow, only takes part.
    trained = {slot: part for slot, part in parts.items() if any(p.requires_grad for p in part.net.parameters())}
    best = BestWeights(folder / "weights", trained, options.top_k, lambda module: {**base, **_figures(module, options)})
    curve = Curve(folder, tracker)
    # The bar comes first, to be gone when another raises; the curve before what is saved; the resume point last.
    watchers: list[Callback] = [Bar()] if shown else []
    watchers += [StopDivergence(options.divergence_factor, options.learning_rate), best]
    watchers += [BestPicture(folder, tracker), FlowPicture(folder, tracker)]
    watchers += [curve, CurvePicture(curve, reference, beside, folder, tracker), ResumePoint(folder, start)]
    folder.mkdir(parents=True, exist_ok=True)
    to_better = math.inf if start is None else _rank(_trainer(options, folder, []), module, data, options)
    _fit(_trainer(options, folder, watchers), module, data, options)
    weights, score = _best(best, trained, to_better)
    return Trained(
        weights=weights, score=score, reference=reference, beside=beside, epochs=len(curve.rows), curve=curve.rows
    )


def _validation_windows(sequences: Sequence[StoredSequence], pairs: int) -> WindowIndex:
    """Longer than in training, where no run of images is too short for it: what answers share is then found once."""
    index = WindowIndex(sequences, pairs, split="validation")
    # Without images there is room for more.
    further = _FURTHER_PAIRS if any(sequence.images.size for sequence in sequences) else 3 * pairs
    longer = min(pairs + further, index.shortest_run)
    return index if longer == pairs else WindowIndex(sequences, longer, split="validation")


def _reference(training: Split, windows: WindowIndex, context: int, options: TrainerOptions) -> tuple[str, Score]:
    """What stands beside the parts, and its score on the pairs that validation answers, and no others."""
    constant = mean_motion(training.sequences)
    motions = [np.tile(constant, (len(sequence) - 1, 1, 1)) for sequence in windows.sequences]
    beside = "constant motion"
    for motion, sequence in zip(motions, windows.sequences, strict=True):
        if sequence.vo is not None:
            beside = "the VO alone"
            motion[sequence.vo.valid] = sequence.vo.T_prev_cur[sequence.vo.valid]
    answered = [np.zeros(len(sequence) - 1, dtype=np.bool_) for sequence in windows.sequences]
    for usable, sequence in zip(answered, windows.sequences, strict=True):
        for place in range(context - 1, windows.pairs):
            usable[sequence.starts(windows.pairs) + place] = True
    return beside, score_motions(
        windows.sequences,
        motions,
        answered,
        lengths_m=[float(length) for length in options.segment_lengths_m],
        step=options.segment_step,
    )


def has_gpu() -> bool:
    """Whether torch can use one here."""
    return torch.cuda.is_available()


def _trainer(options: TrainerOptions, folder: Path, callbacks: list[Callback]) -> lightning.Trainer:
    gpu = options.accelerator != "cpu" and has_gpu()
    precision: Any = {"32": "32-true", "bf16": "bf16-mixed", "16": "16-mixed"}.get(str(options.precision), "32-true")
    if options.precision == "auto" and gpu and torch.cuda.is_bf16_supported():
        precision = "bf16-mixed"
    if gpu:
        torch.set_float32_matmul_precision("high")
    with quiet(), told(f"trainer.accelerator={options.accelerator}, trainer.devices={options.devices}"):
        return lightning.Trainer(
            accelerator=options.accelerator,
            devices=options.devices,
            # A part may leave some of its weights out of its answer, such as an auxiliary head.
            strategy="ddp_find_unused_parameters_true" if options.devices > 1 else "auto",
            precision=precision,
            max_epochs=options.max_epochs,
            max_time=None if options.max_minutes is None else timedelta(minutes=options.max_minutes),
            gradient_clip_val=options.gradient_clip or None,
            check_val_every_n_epoch=min(options.validate_every, options.max_epochs),
            num_sanity_val_steps=0,
            default_root_dir=folder,
            callbacks=callbacks,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
            # Convolutions of one fixed size: trying their variants once pays.
            benchmark=gpu,
        )


def _fit(trainer: lightning.Trainer, module: TrainingModule, data: WindowData, options: TrainerOptions) -> None:
    if isinstance(trainer.accelerator, CUDAAccelerator):
        for parameter in module.nets.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    resume = None if options.resume is None else Path(options.resume).expanduser()
    if resume is not None and not resume.is_file():
        raise DataError(f"trainer.resume={options.resume}: there is no such file; a run writes resume.ckpt each epoch")
    try:
        with running(options), told(f"trainer.max_epochs={options.max_epochs}, trainer.resume={options.resume}"):
            # Weights-only: the file is data, and one that holds anything else is refused.
            trainer.fit(module, datamodule=data, ckpt_path=resume, weights_only=True)
    except (pickle.UnpicklingError, EOFError) as error:
        raise DataError(
            f"trainer.resume={options.resume} is not a whole resume file of vioframe: begin anew"
        ) from error
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        # torch says all of these of a file that is cut or of another net; once a step is done they are bugs.
        if resume is None or module.started:
            raise
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DataError(
            f"trainer.resume={options.resume} does not fit these parts or is not whole ({first}): resume with the "
            "configuration of the run that wrote it, or begin anew"
        ) from error


def _rank(trainer: lightning.Trainer, module: TrainingModule, data: WindowData, options: TrainerOptions) -> float:
    """What the parts reach as they are, on the validation windows."""
    with running(options):
        trainer.validate(module, datamodule=data, verbose=False)
    return module.rank_value if math.isfinite(module.rank_value) else math.inf


def _load(parts: Mapping[str, Trainable], weights: Mapping[str, Path]) -> None:
    for slot, path in weights.items():
        load_weights(path, parts[slot], f"{slot}.weights")
        parts[slot].net.eval()


def _best(
    best: BestWeights, trained: Mapping[str, Trainable], to_better: float
) -> tuple[dict[str, Path], Score | None]:
    """Files of the best weights, which the parts then have, and their score; nothing where none ranks better."""
    weights: dict[str, Path] = {}
    score = None
    if best.best and best.best[0][0] < to_better:
        epoch = best.best[0][1]
        weights = {slot: best.path(slot, epoch) for slot in trained}
        _load(trained, weights)
        figures = read_card(next(iter(weights.values())))["validation"]
        score = Score(**{each.name: figures[each.name] for each in fields(Score)})
    return weights, score


def _card(
    training: Split, validation: Split, options: TrainerOptions, about: Mapping[str, object]
) -> dict[str, object]:
    data = {"training": training.about(), "validation": validation.about()}
    return {
        "data": data,
        "split_sha256": hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest(),
        "code": {"vioframe": __version__, "torch": torch.__version__, "lightning": lightning.__version__},
        "licence": "Apache-2.0, beside the terms of the data, and of the weights it may have started from",
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "trainer": options.settings(),
        **about,
    }


def _figures(module: TrainingModule, options: TrainerOptions) -> dict[str, object]:
    score = module.score
    if score is None:
        return {}
    figures = {**asdict(score), "relative_to_reference": module.rank_value}
    lengths = [float(length) for length in options.segment_lengths_m]
    finite = {name: value if math.isfinite(value) else None for name, value in figures.items()}
    return {"validation": {**finite, "segment_lengths_m": lengths, "protocol": _PROTOCOL}}
