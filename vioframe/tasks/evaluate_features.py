"""``task=evaluate_features``: keypoints and descriptors side by side, on pairs of pictures with a known homography."""

import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import cv2
import numpy as np

from vioframe.build import build
from vioframe.errors import ConfigError, DataError, VioframeError
from vioframe.features.evaluation import Summary, evaluate_pairs, summarise
from vioframe.features.match_picture import draw_matches
from vioframe.features.protocol import FeatureProtocol
from vioframe.features.report import write_report
from vioframe.features.scoring import PairScores, Seen
from vioframe.features.table import print_summaries
from vioframe.pictures.pairs import SPLITS, PicturePair, generated_pairs, hpatches_pairs
from vioframe.tasks.interruption import INTERRUPTED, terminate_like_interrupt
from vioframe.tasks.progress import share_progress
from vioframe.tracking import Tracker
from vioframe.vision.keypoints import Extractor

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger(__name__)


def run(config: "DictConfig") -> int:
    """Evaluate the methods that ``config.task`` chooses; return the exit status.

    A method that cannot be built is told, and the others are evaluated; the status is then 1. After Ctrl-C it is 130,
    and what was done until then is shown.

    Raises:
        ConfigError: an option that cannot work, or no method that can be built.
        DataError: no pairs of pictures.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import OmegaConf

    hydra_config = HydraConfig.get()
    choices = hydra_config.runtime.choices
    task = config.task
    if not config.get("protocol"):
        raise ConfigError("task=evaluate_features needs a protocol: choose one, such as protocol=points_300")
    protocol = build(config, "protocol", FeatureProtocol, str(choices.get("protocol@_global_.protocol", "")))
    _check(task)
    tracker = build(config, "tracker", Tracker, str(choices.get("tracker", "")))
    folder = Path(hydra_config.runtime.output_dir)
    shown = OmegaConf.create({"task": config.task, "protocol": config.protocol})
    parameters = OmegaConf.to_container(shown, resolve=True)
    with _opencv_threads(int(task.threads)), terminate_like_interrupt(), tracker:
        methods, failed = _build_methods(config, protocol)
        count, pairs = _pairs(task, protocol)
        tracker.start(dict(parameters), {"vioframe.kind": "features"}, name=f"features, {protocol.name}")  # type: ignore[arg-type]
        scores: dict[str, list[PairScores]] = {name: [] for name in methods}
        drawn = _Drawings(folder / "matches", int(task.match_pictures), count)
        interrupted = False
        bar = bool(config.progress) and hydra_config.mode != RunMode.MULTIRUN
        with share_progress("pairs", count, shown=bar) as advance:
            try:
                for number, (pair, seen) in enumerate(evaluate_pairs(methods, pairs, protocol), start=1):
                    for name, one in seen.items():
                        scores[name].append(one.scores)
                    drawn.draw(number - 1, pair, seen)
                    advance(number)
            except KeyboardInterrupt:
                interrupted = True
        done = {name: of_method for name, of_method in scores.items() if of_method}
        if not done and not interrupted:
            raise DataError(
                f"{task.hpatches or 'the generated set'} holds no pair of pictures: give task.hpatches=FOLDER"
            )
        if done:
            summaries = [summary for name, of_method in done.items() for summary in summarise(name, of_method)]
            threads = _threads_sentence(int(task.threads), methods)
            yaml = OmegaConf.to_yaml(shown, resolve=True)
            paths = write_report(
                summaries, done, protocol, folder, threads=threads, pictures=drawn.paths, config_yaml=yaml
            )
            print_summaries(summaries, done, protocol, threads)
            _tell(summaries, folder, [*paths, *drawn.paths], tracker)
        if interrupted:
            log.warning("interrupted after %d of %d pairs", len(next(iter(scores.values()))), count)
            tracker.finish("killed", "interrupted by the user")
            return INTERRUPTED
        if failed:
            tracker.finish("failed", "; ".join(failed.values()))
    return 1 if failed else 0


def _check(task: "DictConfig") -> None:
    for key, least in (("pairs", 1), ("match_pictures", 0), ("threads", 1)):
        if task[key] < least:
            raise ConfigError(f"task.{key} must be at least {least}, got {task[key]}")
    unknown = [name for name in task.chosen or () if name not in task.methods]
    if unknown:
        raise ConfigError(f"task.chosen has {', '.join(unknown)}, but the methods are {', '.join(task.methods)}")
    if task.chosen is not None and not task.chosen:
        raise ConfigError("task.chosen is empty: name at least one method, or null for all")


def _build_methods(config: "DictConfig", protocol: FeatureProtocol) -> tuple[dict[str, Extractor], dict[str, str]]:
    """The methods chosen, and why others could not be built or do not work."""
    # A net reads its weights when it is first asked, and everything is slower the first time.
    trial = np.random.default_rng(0).integers(0, 256, protocol.size_px[::-1], dtype=np.uint8)
    methods: dict[str, Extractor] = {}
    failed: dict[str, str] = {}
    for name in map(str, config.task.chosen or config.task.methods):
        try:
            method = build(config, f"task.methods.{name}", Extractor)
            method.extract(trial, np.full_like(trial, 255))
            methods[name] = method
        except VioframeError as error:
            failed[name] = f"{name}: {error}"
            log.error("%s", failed[name])
    if not methods:
        raise ConfigError("no method is left to evaluate: see above, or choose others with task.chosen=[sift,orb]")
    return methods, failed


def _pairs(task: "DictConfig", protocol: FeatureProtocol) -> tuple[int, Iterable[PicturePair]]:
    """How many pairs there are, and the pairs, each made or read when it is asked for."""
    if task.hpatches is not None:
        root = Path(str(task.hpatches))
        stored = hpatches_pairs(root)
        return sum(1 for pattern in ("H_1_*", "*/H_1_*") for _ in root.glob(pattern)), stored
    count = int(task.pairs)

    def made() -> Iterator[PicturePair]:
        for split in SPLITS:
            yield from generated_pairs(split, count, protocol.size_px, int(task.seed))

    return len(SPLITS) * count, made()


class _Drawings:
    """Some pairs, evenly over all of them, drawn into a folder.

    Args:
        folder: made when the first is drawn.
        count: of pairs to draw.
        total: of pairs there are.
    """

    def __init__(self, folder: Path, count: int, total: int) -> None:
        self._folder = folder
        self._wanted = set(np.linspace(0, max(total - 1, 0), min(count, total)).round().astype(int).tolist())
        self.paths: list[Path] = []

    def draw(self, index: int, pair: PicturePair, seen: Mapping[str, Seen]) -> None:
        """Draw the pair of an index if it is one of them."""
        if index in self._wanted:
            self._folder.mkdir(parents=True, exist_ok=True)
            path = self._folder / f"{pair.name.replace('/', '_')}.jpg"
            draw_matches(pair, seen, path)
            self.paths.append(path)


def _tell(summaries: list[Summary], folder: Path, paths: list[Path], tracker: Tracker) -> None:
    from vioframe.evaluation.table import print_places

    for summary in summaries:
        tracker.log_metrics(
            {f"{summary.method}/{summary.split}/{key}": value for key, value in summary.numbers().items()}
        )
    for path in paths:
        tracker.log_file(path, "" if path.parent == folder else path.parent.name)
    print_places(folder, {"report": str(folder / "features.html"), "compare": tracker.hint})


@contextmanager
def _opencv_threads(count: int) -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _threads_sentence(count: int, methods: Mapping[str, Extractor]) -> str:
    """What the times were measured with: threads, and devices of the methods that have a choice."""
    others = os.environ.get("OMP_NUM_THREADS", "all")
    devices = dict.fromkeys(str(method.device()) for method in methods.values() if isinstance(method, _HasDevice))
    networks = f", networks on {', '.join(devices)}" if devices else ""
    return f"OpenCV with {count} thread{'s' * (count != 1)}, others with OMP_NUM_THREADS={others}{networks}"


@runtime_checkable
class _HasDevice(Protocol):
    """A method with a net."""

    def device(self) -> object:
        """Where it works."""
        ...
