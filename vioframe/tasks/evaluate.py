"""``task=evaluate``: compare trajectory files on disk."""

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.errors import ConfigError, VioframeError
from vioframe.evaluation.align import ALIGNMENTS, Alignment, MatchedPoses
from vioframe.evaluation.protocol import EvaluationOptions, describe_association
from vioframe.evaluation.report import make_report
from vioframe.evaluation.rows import Row, compare_trajectories, match, metrics_document, rate_hz
from vioframe.evaluation.table import print_rows
from vioframe.trajectory_io import TrajectoryFormat, read_trajectory
from vioframe.types import Trajectory

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger(__name__)


def run(config: "DictConfig") -> int:
    """Compare the files that ``config.task`` names; return the exit status.

    An estimate that cannot be used is marked, and the others are compared; the status is then 1.
    """
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import ListConfig, MissingMandatoryValue, OmegaConf

    task = config.task
    try:
        given, truth_path = task.estimate, Path(str(task.ground_truth))
    except MissingMandatoryValue as error:
        raise ConfigError(
            f"task=evaluate needs {error.full_key}: give task.estimate=FILE and task.ground_truth=FILE"
        ) from None
    estimates = [Path(str(path)) for path in (given if isinstance(given, ListConfig) else [given])]
    folder = Path(HydraConfig.get().runtime.output_dir)
    plain = OmegaConf.to_container(config.evaluation, resolve=True)
    options = EvaluationOptions(**{str(key): value for key, value in dict(plain).items()})  # type: ignore[arg-type]
    shown = OmegaConf.to_yaml(OmegaConf.create({"task": task, "evaluation": config.evaluation}), resolve=True)
    rows = evaluate_to_folder(
        estimates,
        truth_path,
        folder,
        estimate_format=task.estimate_format,
        ground_truth_format=task.ground_truth_format,
        stamps=None if task.stamps is None else Path(str(task.stamps)),
        alignment=task.alignment,
        offset_s=float(task.offset_s),
        options=options,
        config_yaml=shown,
    )
    print_rows(rows, folder)
    return 1 if any(row["status"] == "failed" for row in rows) else 0


def evaluate_files(
    estimate: Path,
    ground_truth: Path,
    *,
    estimate_format: TrajectoryFormat | None = None,
    ground_truth_format: TrajectoryFormat | None = None,
    stamps: Path | None = None,
    alignment: Alignment = "se3",
    offset_s: float = 0.0,
    options: EvaluationOptions | None = None,
) -> Row:
    """Compare one file with the truth.

    Args:
        estimate, ground_truth: TUM, EuRoC or KITTI files.
        estimate_format, ground_truth_format: None tells them from the files.
        stamps: times of the frames of KITTI files.
        alignment: of ``ate_m``; ``sim3`` also scales the estimate before relative errors are taken.
        offset_s: added to the stamps of the estimate.
        options: of association and segments.

    Returns:
        One entry of ``metrics.json``, with ``ate_m`` in the alignment asked for.

    Raises:
        DataError: a file that cannot be used.
        MetricError: no poses of the two match.
        ConfigError: an unknown alignment.
    """
    _check_alignment(alignment)
    truth = _read(ground_truth, ground_truth_format, stamps)
    trajectory = _read(estimate, estimate_format, stamps)
    return _row(
        estimate.name, estimate, ground_truth, trajectory, truth, options or EvaluationOptions(), alignment, offset_s
    )


def evaluate_to_folder(
    estimates: Sequence[Path],
    ground_truth: Path,
    folder: Path,
    *,
    estimate_format: TrajectoryFormat | None = None,
    ground_truth_format: TrajectoryFormat | None = None,
    stamps: Path | None = None,
    alignment: Alignment = "se3",
    offset_s: float = 0.0,
    options: EvaluationOptions | None = None,
    config_yaml: str = "",
) -> list[Row]:
    """Compare several files with one truth, and write ``metrics.json``, figures and the report.

    Arguments are those of :func:`evaluate_files`; ``config_yaml`` is shown in the report.

    Raises:
        DataError, MetricError: the ground truth or the only estimate cannot be used; one of several is a
            failed row instead.
        ConfigError: an unknown alignment.
    """
    _check_alignment(alignment)
    options = options or EvaluationOptions()
    truth = _read(ground_truth, ground_truth_format, stamps)
    rows: list[Row] = []
    matched: dict[str, MatchedPoses] = {}
    kinds: dict[bool, str] = {}
    for path, name in zip(estimates, _short_names(estimates), strict=True):
        try:
            trajectory = _read(path, estimate_format, stamps)
            rows.append(_row(name, path, ground_truth, trajectory, truth, options, alignment, offset_s))
            matched[name] = match(trajectory, truth, options, offset_s=offset_s)
            kinds.setdefault(trajectory.causal, name)
        except VioframeError as error:
            if len(estimates) == 1:
                raise
            log.error("%s", error)
            rows.append({"sequence": name, "status": "failed", "error": str(error), "windows": 0})
    if len(kinds) > 1:
        log.warning(
            "%s is a final (smoothed) trajectory and %s is not: their errors are not of one kind",
            kinds[False],
            kinds[True],
        )
    folder.mkdir(parents=True, exist_ok=True)
    document = metrics_document(rows, options)
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")
    if options.plots:
        _write_report(rows, matched, truth, options, alignment, folder, config_yaml)
    return rows


def _write_report(
    rows: Sequence[Row],
    matched: Mapping[str, MatchedPoses],
    truth: Trajectory,
    options: EvaluationOptions,
    alignment: Alignment,
    folder: Path,
    config_yaml: str,
) -> None:
    from vioframe.evaluation.comparison import draw_comparison

    figures = draw_comparison(matched, truth, options, alignment, folder / "plots")
    page = make_report(rows, [{} for _ in rows], config_yaml=config_yaml, options=options, shared_figures=figures)
    (folder / "report.html").write_text(page, encoding="utf-8")


def _check_alignment(alignment: str) -> None:
    if alignment not in ALIGNMENTS:
        raise ConfigError(f"task.alignment must be one of {', '.join(ALIGNMENTS)}, got {alignment!r}")


def _read(path: Path, format: TrajectoryFormat | None, stamps: Path | None) -> Trajectory:
    from vioframe.tables import read_table
    from vioframe.trajectory_io import detect_format

    if stamps is None:
        return read_trajectory(path, format)
    # Only KITTI files take stamps from outside; the other one of the two may well have its own.
    kind = format or detect_format(read_table(path, what="poses"))
    return read_trajectory(path, kind, stamps if kind == "kitti" else None)


def _row(
    name: str,
    path: Path,
    truth_path: Path,
    estimate: Trajectory,
    truth: Trajectory,
    options: EvaluationOptions,
    alignment: Alignment,
    offset_s: float,
) -> Row:
    metrics = compare_trajectories(estimate, truth, options, alignment=alignment, offset_s=offset_s)
    protocol: Row = {
        "output": "file" if estimate.causal else "final",
        "rate_hz": rate_hz(estimate.stamps_ns),
        "truth_rate_hz": rate_hz(truth.stamps_ns),
        "alignment": ALIGNMENTS[alignment],
        "association": describe_association(options),
        "offset_s": offset_s,
    }
    files: Row = {"estimate": str(path), "ground_truth": str(truth_path)}
    return {"sequence": name, "status": "finished", "error": None, **files, **metrics, "protocol": protocol}


def _short_names(paths: Sequence[Path]) -> list[str]:
    """File names, with as many parents as it takes to tell them apart."""
    for depth in range(1, max((len(path.parts) for path in paths), default=1) + 1):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{path} ({number})" for number, path in enumerate(paths, start=1)]
