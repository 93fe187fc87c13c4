"""``task=experiment``: run every test sequence, evaluate, draw, log."""

import json
import logging
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from vioframe import __version__
from vioframe.build import build, build_dataset, build_pipeline
from vioframe.data.faults import Faults
from vioframe.data.recording import Dataset, Recording
from vioframe.errors import VioframeError
from vioframe.evaluation.protocol import EvaluationOptions
from vioframe.evaluation.report import write_outputs
from vioframe.evaluation.rows import evaluate_run, metrics_document
from vioframe.evaluation.run import SequenceRun
from vioframe.evaluation.table import print_rows
from vioframe.learning.figures import model_figures
from vioframe.pipeline import Pipeline, check_rig
from vioframe.sweep import write_status
from vioframe.tasks.interruption import INTERRUPTED, terminate_like_interrupt
from vioframe.tasks.progress import frame_progress
from vioframe.tasks.provision import provide_weights, untrained_slots
from vioframe.tasks.run_sequence import Recorder, run_sequence
from vioframe.tracking import Tracker, metrics_of
from vioframe.viewer import Viewer, build_viewer

log = logging.getLogger(__name__)


def run(config: DictConfig) -> int:
    """Run the experiment that ``config`` describes; return the exit status.

    A sequence that fails is marked, and the others are run; the status is then 1, and 130 after Ctrl-C.
    """
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    choices = {group: str(option) for group, option in hydra_config.runtime.choices.items()}
    options = build_options(config)
    in_sweep = hydra_config.mode == RunMode.MULTIRUN
    pipeline = build_pipeline(config, choices)
    dataset = build_dataset(config, choices.get("dataset", ""))
    if untrained_slots(pipeline):
        # What the recordings would have refused is refused before the time of a training is spent.
        check_rig(pipeline.parts(), dataset.open(dataset.sequences[0]).rig, choices)
        with terminate_like_interrupt():
            try:
                provide_weights(config, choices, pipeline, dataset, shown=bool(config.progress) and not in_sweep)
            except KeyboardInterrupt:
                return INTERRUPTED
        pipeline = build_pipeline(config, choices)
    tracker = build(config, "tracker", Tracker, choices.get("tracker", ""))
    viewer = build_viewer(config, choices)
    resolved = OmegaConf.to_yaml(config, resolve=True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(resolved, encoding="utf-8")
    tags = {slot: choices.get(slot, "none") for slot in (*pipeline.parts(), "dataset", "system")}
    plain = OmegaConf.to_container(config, resolve=True)
    tags["faults"] = ", ".join(build(config, "faults", Faults).describe()) or "none"
    parameters = {str(key): value for key, value in plain.items()} if isinstance(plain, dict) else {}
    experiment = _Experiment(config, folder, options, pipeline, dataset, tracker, viewer, choices)
    with terminate_like_interrupt(), tracker:
        tracker.start(parameters, tags, name=_run_name(pipeline, choices))
        status = experiment.run(in_sweep=in_sweep)
        if status == INTERRUPTED:
            tracker.finish("killed", "interrupted by the user")
        elif status:
            tracker.finish("failed", "; ".join(experiment.failures()))
    return status


def build_options(config: DictConfig) -> EvaluationOptions:
    """The metrics' options, checked."""
    plain = OmegaConf.to_container(config.evaluation, resolve=True)
    return EvaluationOptions(**{str(name): value for name, value in dict(plain).items()})  # type: ignore[arg-type]


def _run_name(pipeline: Pipeline, choices: dict[str, str]) -> str:
    return " ".join(choices[slot] for slot in pipeline.parts() if slot in choices and slot != "synchronizer")


class _Experiment:
    """The sequences of one experiment, and what became of each."""

    def __init__(
        self,
        config: DictConfig,
        folder: Path,
        options: EvaluationOptions,
        pipeline: Pipeline,
        dataset: Dataset,
        tracker: Tracker,
        viewer: Viewer | None,
        choices: dict[str, str],
    ) -> None:
        self.config = config
        self.folder = folder
        self.options = options
        self.pipeline = pipeline
        self.dataset = dataset
        self.tracker = tracker
        self.viewer = viewer
        self.choices = choices
        self.runs: list[SequenceRun] = []
        self.rows: list[dict[str, object]] = []
        self._recorders: list[Recorder] = []
        self._bug: BaseException | None = None
        self._model = model_figures(pipeline.parts())

    def failures(self) -> list[str]:
        """One sentence for each sequence that did not finish."""
        return [f"{run.sequence}: {run.error}" for run in self.runs if run.error is not None]

    def run(self, *, in_sweep: bool) -> int:
        """Run all sequences; write, print and log what came out, also when it is not all."""
        progress = bool(self.config.progress) and not in_sweep
        for name in self.dataset.sequences:
            try:
                recording = self.dataset.open(name)
            except VioframeError as error:
                log.error("%s", error)
                self._take(_unopened(name, str(error)), None)
                continue
            if self._run_one(recording, progress=progress):
                break
        self._finish()
        if in_sweep:
            log.info("%s", self.folder)
        else:
            watch = "" if self.viewer is None else self.viewer.hint
            print_rows(self.rows, self.folder, hints={"compare": self.tracker.hint, "watch": watch})
        if self._bug is not None:
            raise self._bug
        if any(run.interrupted for run in self.runs):
            return INTERRUPTED
        return 1 if self.failures() else 0

    def _run_one(self, recording: Recording, *, progress: bool) -> bool:
        """Run one sequence; return whether the experiment should stop there."""
        with frame_progress(recording.name, recording.frame_count, shown=progress) as advance:
            try:
                run, recorder, stop = run_sequence(
                    self.pipeline,
                    recording,
                    folder=self.folder,
                    init=str(self.config.init),
                    sample_count=int(self.config.report_frames),
                    progress=advance,
                    viewer=self.viewer,
                )
            except VioframeError as error:
                # Refused before the first packet: no camera, no ground truth to start from.
                log.error("%s", error)
                self._take(_unopened(recording.name, str(error)), None)
                return False
        if run.error is not None:
            log.error("%s: %s", recording.name, run.error)
        if stop is not None and not isinstance(stop, VioframeError | KeyboardInterrupt):
            self._bug = stop
        self._take(run, recorder)
        return run.interrupted or self._bug is not None

    def _take(self, run: SequenceRun, recorder: Recorder | None) -> None:
        self.runs.append(run)
        self.rows.append(evaluate_run(run, self.options))
        if recorder is not None:
            self._recorders.append(recorder)
        # Each finished sequence is safe on disk before the next one starts.
        document = metrics_document(self.rows, self.options, self._about())
        (self.folder / "metrics.json").write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")

    def _about(self) -> dict[str, object]:
        about: dict[str, object] = {
            "vioframe": __version__,
            "parts": {slot: self.choices.get(slot, "none") for slot in self.choices},
        }
        return {**about, "model": self._model} if self._model else about

    def _finish(self) -> None:
        document = write_outputs(
            self.runs,
            self.rows,
            self.folder,
            config_yaml=(self.folder / "config.yaml").read_text(encoding="utf-8"),
            options=self.options,
            extra=self._about(),
        )
        for recorder in self._recorders:
            recorder.discard_partial()
        status = (
            "interrupted" if any(run.interrupted for run in self.runs) else "failed" if self.failures() else "finished"
        )
        write_status(self.folder, status, "; ".join(self.failures()))
        self.tracker.log_metrics(metrics_of(document))
        for name in ("metrics.json", "config.yaml", "report.html"):
            if (self.folder / name).exists():
                self.tracker.log_file(self.folder / name)
        for path in sorted(self.folder.rglob("*.tum")):
            self.tracker.log_file(path, path.parent.relative_to(self.folder).as_posix().removeprefix("."))
        if (self.folder / "plots").is_dir():
            self.tracker.log_folder(self.folder / "plots", "plots")


def _unopened(name: str, error: str) -> SequenceRun:
    return SequenceRun(
        sequence=name, states=[], frames_expected=0, duration_s=0.0, pipeline_s=0.0, windows=0, wall_s=0.0, error=error
    )
