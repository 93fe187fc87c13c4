"""One cell: run by the code of an experiment, kept under the hash of all that has a bearing on it."""

import hashlib
import json
import logging
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vioframe import __version__
from vioframe.build import build_dataset, build_pipeline
from vioframe.errors import ConfigError, VioframeError
from vioframe.evaluation.rows import evaluate_run, metrics_document
from vioframe.tasks.bearing import bearing
from vioframe.tasks.experiment import build_options
from vioframe.tasks.run_sequence import run_sequence
from vioframe.tracking.records import metrics_of

# What a cell is recorded or shown with has no bearing on it; nor has a training, once its weights are there.
_NO_BEARING = (
    "task",
    "study",
    "experiment",
    "system",
    "tracker",
    "viewer",
    "progress",
    "report_frames",
    "trainer",
    "training_data",
    # Chosen by themselves, they stand in the part that they are for.
    "backbone",
    "encoder",
    "descriptor_loss",
)
# Characters of what is told of a failed cell.
_LONGEST_ERROR = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class CellResult:
    """What became of a cell.

    Attributes:
        key: hash of all that has a bearing on it; empty where it could not be composed.
        status: ``finished`` or ``failed``.
        error: one sentence where it failed.
        metrics: by name, as ``metrics_of`` gives them: the mean over the sequences.
        undefined: reasons by metric, of the first sequence that lacks it.
        counters: what parts and recordings counted, summed over the sequences.
        wall_s: seconds it took.
        stored: it was there already.
    """

    key: str
    status: str
    error: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    undefined: dict[str, str] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)
    wall_s: float = 0.0
    stored: bool = False


def failed(error: BaseException, key: str = "") -> CellResult:
    """A cell that an error ended."""
    text = str(error) if isinstance(error, VioframeError) else f"{type(error).__name__}: {error}"
    return CellResult(key=key, status="failed", error=_one_line(text))


def _one_line(text: str) -> str:
    """What libraries say over several lines, a cell of a table says in one."""
    words = " ".join(text.split())
    return words if len(words) <= _LONGEST_ERROR else words[: _LONGEST_ERROR - 1] + "…"


def cell_key(config: DictConfig) -> str:
    """Hash of what has a bearing on a cell: its config, its weights by content, and the version.

    Raises:
        ConfigError: an option leads nowhere, or is missing.
    """
    plain = {str(name): _plain(config, str(name)) for name in config if name not in _NO_BEARING}
    # Whether figures are drawn changes no number, nor does how a part would train itself.
    words = [__version__, bearing(plain, without=("plots", "training"))]
    return hashlib.sha256(json.dumps(words, sort_keys=True, default=str).encode()).hexdigest()[:24]


def _plain(config: DictConfig, name: str) -> object:
    # One by one, so that what is left out need not be resolved; interpolations may still lead there.
    try:
        node = config[name]
        return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
    except OmegaConfBaseException as error:
        raise ConfigError(f"{name}: {str(error).strip().splitlines()[0]}") from error


class CellStore:
    """The cells that are there, a JSON file each.

    Args:
        folder: of the files; made when the first is kept.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def find(self, key: str) -> CellResult | None:
        """The finished cell of this key, or None; a file that cannot be read is none."""
        try:
            document = json.loads(self._path(key).read_text(encoding="utf-8"))
            known = {name: document[name] for name in ("metrics", "undefined", "counters", "wall_s")}
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return CellResult(key=key, status="finished", stored=True, **known)

    def keep(self, result: CellResult, about: Mapping[str, object]) -> None:
        """Keep a finished cell; one that failed is run again the next time."""
        if result.status != "finished":
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        document = {**asdict(result), "vioframe": __version__, "about": dict(about)}
        partial = self._path(result.key).with_suffix(f".{os.getpid()}.partial")
        partial.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        os.replace(partial, self._path(result.key))

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.json"


def run_cell(config: DictConfig, choices: Mapping[str, str], key: str) -> CellResult:
    """Run every sequence of a cell and evaluate it; whatever goes wrong comes back as a failed cell.

    Args:
        config: the whole, with weights for every part that needs some.
        choices: the option chosen in each group.
        key: of the cell.
    """
    started = time.perf_counter()
    rows = []
    try:
        options = build_options(config)
        pipeline = build_pipeline(config, choices)
        dataset = build_dataset(config, choices.get("dataset", ""))
        with tempfile.TemporaryDirectory(prefix="vioframe_cell_") as temporary, _without_warnings():
            for name in dataset.sequences:
                run, recorder, stop = run_sequence(
                    pipeline,
                    dataset.open(name),
                    folder=Path(temporary),
                    init=str(config.init),
                    sample_count=0,
                    progress=_nobody,
                )
                if isinstance(stop, KeyboardInterrupt):
                    raise stop
                if run.error is not None:
                    return CellResult(key=key, status="failed", error=_one_line(f"{name}: {run.error}"))
                rows.append(evaluate_run(run, options))
                recorder.discard_partial()
    except Exception as error:  # noqa: BLE001 - one cell must not end a study; its error is told in the table
        return failed(error, key)
    undefined: dict[str, str] = {}
    counters: dict[str, int] = {}
    for row in rows:
        reasons, counted = row["undefined"], row["counters"]
        undefined = {**(reasons if isinstance(reasons, dict) else {}), **undefined}
        for name, count in (counted if isinstance(counted, dict) else {}).items():
            counters[name] = counters.get(name, 0) + count
    return CellResult(
        key=key,
        status="finished",
        metrics=metrics_of(metrics_document(rows, options)),
        undefined=undefined,
        counters=counters,
        wall_s=time.perf_counter() - started,
    )


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Parts warn of what faults do to them, which is what a study is about; it is counted all the same."""
    before = logging.root.manager.disable
    logging.disable(max(before, logging.WARNING))
    try:
        yield
    finally:
        logging.disable(before)


def _nobody(done: int) -> None:
    """Progress that nobody watches."""
