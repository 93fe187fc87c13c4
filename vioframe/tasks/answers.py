"""What the VO of a pipeline answers for the recordings of a training: asked once, then found again.

The answers lie in ``trainer.cache/answers``, one file a recording, named by a hash of all that went in: the recording's
content, the options of front end and VO, of their weights the content, and the version of this package. How a VO is
asked depends on what it needs:

- with a net: the decoded images, at the size of the net, in batches where that is the same as a stream;
- nothing (it draws from the truth, which is lent to it): the stamps of the recording, ``training_data.draws`` times,
  each time with other noise;
- anything else: the recording itself, streamed through synchronizer, front end and integrator as an experiment does.
"""

import hashlib
import itertools
import json
import logging
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from vioframe import __version__
from vioframe.build import build, build_pipeline
from vioframe.data.answers import answers_digest, read_answers, stack_answers, write_answers
from vioframe.data.sequence_cache import read_stored
from vioframe.data.windows import PairAnswers, StoredSequence
from vioframe.errors import ConfigError
from vioframe.interfaces import (
    Component,
    Frontend,
    Fuser,
    Trainable,
    UsesGroundTruth,
    VOEstimator,
)
from vioframe.pipeline import SLOTS, Pipeline
from vioframe.tasks.bearing import bearing, bearing_of
from vioframe.tasks.decoding import DecodingJob, decode, decoding_jobs, read_splits, splits_of
from vioframe.tasks.pool import in_processes, telling
from vioframe.tasks.run_sequence import lend_ground_truth
from vioframe.types import Frame, ImuNoise, Measurement, NavState, Packet, RelativePose, SensorRig, VisualFeatures

if TYPE_CHECKING:
    from vioframe.learning.options import TrainerOptions
    from vioframe.learning.training import Split

log = logging.getLogger(__name__)

_ASKED = ("frontend", "vo")
_STREAMED = ("synchronizer", "frontend", "vo", "integrator")
_MOST_DRAWS = 1000
# Of the validation recordings: enough to choose weights by.
_MOST_VALIDATION_DRAWS = 3


def read_answered_splits(
    config: DictConfig, options: "TrainerOptions", choices: Mapping[str, str], *, shown: bool
) -> "tuple[Split, Split]":
    """The recordings of ``training_data`` with what the VO of ``config`` answers, and without images.

    Args:
        config: the whole; its VO has weights, or needs none.
        options: size and place of what is decoded.
        choices: by group, for messages.
        shown: whether to show progress bars.

    Raises:
        ConfigError: the VO cannot be asked.
        DataError: a recording that cannot be read or stored.
    """
    pipeline = build_pipeline(config, choices)
    vo = pipeline.vo
    if vo is None:
        return read_splits(config, options, choices, shown=shown, images=False)
    store = _Store(Path(options.cache).expanduser() / "answers", choices.get("vo", "vo"))
    if isinstance(vo, Trainable):
        return _ask_net(config, options, choices, store, shown=shown)
    if pipeline.frontend is None and not vo.requires:
        return _ask_drawing(config, options, choices, store, shown=shown)
    jobs = decoding_jobs(config, options, choices, images=False)
    parts = {slot: OmegaConf.to_container(config[slot], resolve=True) for slot in _STREAMED if config.get(slot)}
    named = {slot: choices.get(slot, "") for slot in parts}
    asked = in_processes(
        _stream,
        [_StreamJob(decoding=job, parts=parts, choices=named, store=store) for job in jobs],
        title=f"asking vo={choices.get('vo', '')} for {len(jobs)} recordings",
        shown=shown,
    )
    train, validation = splits_of(jobs, [folder for folder, _ in asked])
    answers = iter([read_answers(path) for _, path in asked])
    return _answered(train, answers), _answered(validation, answers)


@dataclass(frozen=True, slots=True, kw_only=True)
class _StreamJob:
    """One recording to stream, as it travels to another process."""

    decoding: DecodingJob
    parts: Mapping[str, Any]
    choices: Mapping[str, str]
    store: "_Store"


@dataclass(frozen=True, slots=True, kw_only=True)
class _NetJob:
    """One stored recording to ask a VO with a net for, as it travels to another process."""

    stored: Path
    parts: Mapping[str, Any]
    choices: Mapping[str, str]
    batch_size: int
    path: Path


@dataclass(frozen=True, slots=True)
class _Store:
    """Where answers are kept: a folder, and what the VO is called."""

    folder: Path
    name: str

    def path(self, recording: str, *words: object) -> Path:
        """The file of one recording's answers; ``words`` are all that has a bearing on them."""
        text = json.dumps([__version__, *words], sort_keys=True, default=str)
        return self.folder / f"{self.name}-{recording}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"


def _ask_net(
    config: DictConfig, options: "TrainerOptions", choices: Mapping[str, str], store: _Store, *, shown: bool
) -> "tuple[Split, Split]":
    from vioframe.learning.training import has_gpu

    jobs = decoding_jobs(config, options, choices, images=True)
    folders = decode(jobs, shown=shown)
    splits = splits_of(jobs, folders)
    parts = {slot: OmegaConf.to_container(config[slot], resolve=True) for slot in _ASKED if config.get(slot)}
    words = {slot: bearing(node) for slot, node in parts.items()}
    named = {slot: choices.get(slot, "") for slot in parts}
    sequences = [sequence for split in splits for sequence in split.sequences]
    contents = [content for split in splits for content in split.hashes]
    paths = [store.path(one.name, content, words) for one, content in zip(sequences, contents, strict=True)]
    missing = [
        _NetJob(stored=folder, parts=parts, choices=named, batch_size=options.batch_size, path=path)
        for folder, path in zip(folders, paths, strict=True)
        if not path.is_file()
    ]
    title = f"asking vo={choices.get('vo', '')} for {len(missing)} recordings"
    # Processes would only get in each other's way on one GPU.
    in_processes(_ask, missing, title=title, shown=shown, most=1 if has_gpu() else None)
    answers = iter([read_answers(path) for path in paths])
    return _answered(splits[0], answers), _answered(splits[1], answers)


def _ask(job: _NetJob) -> None:
    """In a process of the pool: ask the VO for one recording."""
    import torch

    from vioframe.learning.answers import LearnedAnswers

    if torch.get_num_threads() > 1:
        # As many processes as cores have been started.
        torch.set_num_threads(1)
    frontend, vo = (_part(job.parts, job.choices, slot) for slot in _ASKED)
    if not isinstance(vo, VOEstimator) or not (frontend is None or isinstance(frontend, Frontend)):
        raise ConfigError(f"vo={job.choices.get('vo', '')} cannot be asked for motions")
    sequence, _ = read_stored(job.stored)
    advance = telling(len(sequence))
    write_answers(job.path, LearnedAnswers(frontend, vo, job.batch_size).answer(sequence, advance))
    advance(len(sequence))


def _ask_drawing(
    config: DictConfig, options: "TrainerOptions", choices: Mapping[str, str], store: _Store, *, shown: bool
) -> "tuple[Split, Split]":
    draws = _draws(config)
    splits = read_splits(config, options, choices, shown=shown, images=False)
    made: list[Split] = []
    for split, count in zip(splits, (draws, min(draws, _MOST_VALIDATION_DRAWS)), strict=True):
        sequences, hashes = [], []
        for sequence, content in zip(split.sequences, split.hashes, strict=True):
            for draw in range(count):
                changed = _with_seed(config, sequence.name, draw)
                path = store.path(sequence.name, content, bearing_of(changed, "vo"), draw)
                if not path.is_file():
                    write_answers(path, _draw(build(changed, "vo", VOEstimator, choices.get("vo", "")), sequence))
                answers = read_answers(path)
                name = sequence.name if count == 1 else f"{sequence.name}.draw{draw}"
                sequences.append(replace(sequence, name=name, vo=answers))
                hashes.append(_joined(content, answers))
        made.append(replace(split, sequences=tuple(sequences), hashes=tuple(hashes)))
    return made[0], made[1]


def _draws(config: DictConfig) -> int:
    draws = OmegaConf.select(config, "training_data.draws", default=1)
    if not isinstance(draws, int) or not 1 <= draws <= _MOST_DRAWS:
        raise ConfigError(f"training_data.draws must be a whole number from 1 to {_MOST_DRAWS}, got {draws!r}")
    return draws if "seed" in config.vo else 1


def _with_seed(config: DictConfig, recording: str, draw: int) -> DictConfig:
    """No draw of one recording is that of another, nor that of a test; it is the same whatever others there are."""
    if "seed" not in config.vo:
        return config
    changed = OmegaConf.create({"vo": OmegaConf.to_container(config.vo, resolve=True)})
    changed.vo.seed = int(changed.vo.seed) + 1 + draw + _MOST_DRAWS * (zlib.crc32(recording.encode()) % 1_000_000)
    return changed


def _draw(vo: VOEstimator, sequence: StoredSequence) -> PairAnswers:
    """What a VO that looks at nothing but the truth says for each pair."""
    noise = ImuNoise(gyro_noise=0.0, gyro_walk=0.0, accel_noise=0.0, accel_walk=0.0, rate_hz=100.0)
    vo.setup(SensorRig(cameras=(sequence.camera,), imu=noise, gravity=sequence.gravity, has_images=False))
    if isinstance(vo, UsesGroundTruth):
        vo.take_ground_truth(sequence.truth)
    seen = [VisualFeatures(frame=Frame(stamp_ns=int(stamp), images=())) for stamp in sequence.stamps_ns]
    return stack_answers(
        sequence.stamps_ns,
        {(one.frame.stamp_ns, two.frame.stamp_ns): vo.estimate(one, two) for one, two in itertools.pairwise(seen)},
    )


class _Listener(Fuser):
    """In the place of a fuser: keeps what the VO says."""

    def __init__(self) -> None:
        self.poses: dict[tuple[int, int], RelativePose] = {}

    def update(self, measurement: Measurement) -> list[NavState]:
        """Keep the relative pose."""
        window = measurement.window
        if measurement.relative_pose is not None:
            self.poses[(window.previous.stamp_ns, window.current.stamp_ns)] = measurement.relative_pose
        return []


def _stream(job: _StreamJob) -> tuple[Path, Path]:
    """In a process of the pool: folders of the stored recording and of the answers."""
    recording = job.decoding.open()
    advance = telling(recording.frame_count + 1)
    cache, source = job.decoding.cache, job.decoding.source
    stored = cache.place(recording, source)
    path = job.store.path(recording.name, stored.name, bearing(dict(job.parts)))
    if path.is_file():
        cache.store(recording, source, advance)
    else:
        listener = _Listener()
        pipeline = _listening(job, listener)
        pipeline.setup(recording.rig)
        lend_ground_truth(pipeline, recording.ground_truth(), recording.name)
        heard = 0

        def push(packet: Packet) -> None:
            nonlocal heard
            pipeline.push(packet)
            heard += 1

        # What is decoded for one purpose is decoded for both, unless it was before: by another run just now, perhaps.
        cache.store(recording, source, advance, push)
        if not heard:
            for packet in recording.packets():
                push(packet)
                advance(min(heard, recording.frame_count))
        pipeline.flush()
        write_answers(path, stack_answers(read_stored(stored)[0].stamps_ns, listener.poses))
    advance(recording.frame_count + 1)
    return stored, path


def _listening(job: _StreamJob, listener: _Listener) -> Pipeline:
    parts: dict[str, Any] = {slot: _part(job.parts, job.choices, slot) for slot in job.parts}
    return Pipeline(**parts, fuser=listener, choices=job.choices)


def _part(parts: Mapping[str, Any], choices: Mapping[str, str], slot: str) -> Component | None:
    """The part of one slot, or None where it is empty."""
    if slot not in parts:
        return None
    return build(OmegaConf.create({slot: dict(parts[slot])}), slot, SLOTS[slot], choices.get(slot, ""))


def _answered(split: "Split", answers: Iterator[PairAnswers]) -> "Split":
    """The split with answers in the place of images."""
    sequences, hashes = [], []
    for sequence, content in zip(split.sequences, split.hashes, strict=True):
        answered = next(answers)
        none = np.zeros((len(sequence), 0, 0, 1), dtype=np.uint8)
        sequences.append(replace(sequence, images=none, vo=answered))
        hashes.append(_joined(content, answered))
    return replace(split, sequences=tuple(sequences), hashes=tuple(hashes))


def _joined(content: str, answers: PairAnswers) -> str:
    """One hash of a recording and what was answered for it."""
    return hashlib.sha256(f"{content} {answers_digest(answers)}".encode()).hexdigest()
