"""The recordings of a training, decoded into the cache by as many processes as there are cores."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from vioframe.build import build
from vioframe.data.recording import Dataset, Recording
from vioframe.data.sequence_cache import SequenceCache, read_stored
from vioframe.data.windows import check_no_shared_images, check_split
from vioframe.tasks.pool import in_processes, telling

if TYPE_CHECKING:
    from vioframe.learning.options import TrainerOptions
    from vioframe.learning.training import Split

SPLITS = ("train", "validation")
# What names a recording; its cache entry must not depend on which others were asked for.
_NAMING = ("sequence", "seed", "leave_out", "skip_last", "only_last")


@dataclass(frozen=True, slots=True, kw_only=True)
class DecodingJob:
    """One recording to decode, as it travels to another process.

    Attributes:
        data: the configuration of all recordings, plain, where the config has it.
        split: ``train`` or ``validation``.
        choice: what ``training_data`` was chosen, for messages.
        name: of the recording.
        source: what it is opened from, as text, less what names it.
        cache: where it is kept.
    """

    data: dict[str, Any]
    split: str
    choice: str
    name: str
    source: str
    cache: SequenceCache

    def open(self) -> Recording:
        """The recording.

        Raises:
            DataError: it cannot be read.
        """
        return build(OmegaConf.create(self.data), f"training_data.{self.split}", Dataset, self.choice).open(self.name)


def read_splits(
    config: DictConfig, options: "TrainerOptions", choices: Mapping[str, str], *, shown: bool, images: bool = True
) -> "tuple[Split, Split]":
    """Decode the recordings of ``training_data``, or find them decoded.

    Args:
        config: with ``training_data.train`` and ``training_data.validation``, each a data set.
        options: size and place of what is decoded.
        choices: by group, for messages.
        shown: whether to show a progress bar.
        images: whether images are wanted.

    Raises:
        ConfigError: a recording of both splits.
        DataError: a recording that cannot be read or stored.
    """
    jobs = decoding_jobs(config, options, choices, images=images)
    return splits_of(jobs, decode(jobs, shown=shown))


def decode(jobs: Sequence[DecodingJob], *, shown: bool) -> list[Path]:
    """Folders of the stored recordings, which are decoded now if they were not before.

    Raises:
        DataError: a recording that cannot be read or stored.
    """
    return in_processes(_store, jobs, title=f"reading {len(jobs)} recordings", shown=shown)


def decoding_jobs(
    config: DictConfig, options: "TrainerOptions", choices: Mapping[str, str], *, images: bool
) -> list[DecodingJob]:
    """The recordings of both splits; arguments and errors as of :func:`read_splits`."""
    width, height = (int(size) for size in options.size_px) if len(options.size_px) == 2 else (0, 0)
    cache = SequenceCache(
        Path(options.cache).expanduser() / "recordings",
        size_px=(width, height),
        channels=options.channels,
        images=images,
    )
    data = {"training_data": OmegaConf.to_container(config.training_data, resolve=True)}
    choice = choices.get("training_data", "")
    datasets = {split: build(config, f"training_data.{split}", Dataset, choice) for split in SPLITS}
    check_split(datasets["train"].sequences, datasets["validation"].sequences)
    return [
        DecodingJob(data=data, split=split, choice=choice, name=name, source=_source(data, split), cache=cache)
        for split, dataset in datasets.items()
        for name in dataset.sequences[: options.recordings if split == "train" else None]
    ]


def splits_of(jobs: Sequence[DecodingJob], folders: Sequence[Path]) -> "tuple[Split, Split]":
    """Training and validation from where the jobs' recordings are kept.

    Raises:
        ConfigError: stretches of one recording that overlap.
        DataError: a folder is damaged.
    """
    from vioframe.learning.training import Split

    splits = []
    for split in SPLITS:
        found = [read_stored(folder) for job, folder in zip(jobs, folders, strict=True) if job.split == split]
        splits.append(Split(sequences=tuple(one for one, _ in found), hashes=tuple(content for _, content in found)))
    check_no_shared_images(splits[0].sequences, splits[1].sequences)
    return splits[0], splits[1]


def _source(data: Mapping[str, Any], split: str) -> str:
    return OmegaConf.to_yaml(OmegaConf.create(_unnamed(data["training_data"][split])), sort_keys=True)


def _unnamed(node: Mapping[str, Any]) -> dict[str, Any]:
    """A data set's options less those that name recordings, and the same of those it is made from."""
    return {
        name: _unnamed(value) if isinstance(value, dict) else value
        for name, value in node.items()
        if name not in _NAMING
    }


def _store(job: DecodingJob) -> Path:
    recording = job.open()
    total = recording.frame_count + 1
    advance = telling(total)
    folder = job.cache.store(recording, job.source, advance)
    advance(total)
    return folder
