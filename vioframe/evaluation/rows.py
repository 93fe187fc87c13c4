"""One sequence, one row: every metric by name, and the reason wherever there is none."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from vioframe.checks import Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.errors import MetricError
from vioframe.evaluation import metrics
from vioframe.evaluation.align import Alignment, MatchedPoses, align, associate, path_length
from vioframe.evaluation.attempts import attempt_entries
from vioframe.evaluation.protocol import EvaluationOptions, Output, Protocol, describe_options
from vioframe.evaluation.run import SequenceRun
from vioframe.evaluation.states import StateColumns
from vioframe.types import Trajectory

Row = dict[str, object]
"""One entry of ``metrics.json``: plain values only."""

FARTHEST_M = 1e9
"""A position beyond this has nothing to do with the recording, and its square would swamp every sum."""

NEVER_STARTED = "the system never left status starting, so there is no pose to compare"
NO_TRUTH = "the recording has no ground truth"


class _Cells:
    """Metrics of one trajectory as they are found, and the reasons of those that are not."""

    def __init__(self) -> None:
        self.values: Row = {}
        self.undefined: dict[str, str] = {}

    def add(self, names: Sequence[str], compute: Callable[[], Sequence[float]]) -> None:
        """Add what ``compute`` returns, in order; where it refuses, each is None for that reason."""
        try:
            values = [float(value) for value in compute()]
        except MetricError as error:
            self.refuse(names, str(error))
            return
        for name, value in zip(names, values, strict=True):
            if math.isfinite(value):
                self.values[name] = value
            else:
                self.refuse([name], f"the value is {value}: the estimate has diverged beyond what can be computed")

    def refuse(self, names: Sequence[str], reason: str) -> None:
        """Mark metrics as undefined."""
        for name in names:
            self.values[name] = None
            self.undefined[name] = reason


def evaluate_run(run: SequenceRun, options: EvaluationOptions | None = None) -> Row:
    """Compute one entry of ``metrics.json``.

    Args:
        run: finished or not; what is there is evaluated.
        options: the default protocol if None.

    Returns:
        Plain numbers, strings, lists and dicts. A metric that is not defined is None, with its reason in
        ``undefined``; no value is NaN or infinite.
    """
    options = options or EvaluationOptions()
    columns = StateColumns.from_states(run.states)
    states = columns.started()
    by_status = {str(status): int((columns.status == status).sum()) for status in ("starting", "tracking", "lost")}
    row: Row = {"sequence": run.sequence, "status": run.status, "error": run.error}
    cells = _accuracy(states.trajectory(), run.ground_truth, options)
    _add_consistency(cells, states, run, options)
    windows_expected = max(run.frames_expected - 1, 0)

    def completion() -> list[float]:
        if windows_expected == 0:
            raise MetricError(f"the recording has {run.frames_expected} frames, and a window needs two")
        return [min(by_status["tracking"] / windows_expected, 1.0)]

    cells.add(["completion"], completion)
    cells.add(["real_time_factor"], lambda: [_real_time_factor(run)])
    row |= cells.values
    row["ms_per_frame"] = milliseconds_per_frame(run)
    row |= {
        "frames": run.frames_expected,
        "windows": run.windows,
        "states": by_status,
        "duration_s": run.duration_s,
        "pipeline_s": run.pipeline_s,
        "wall_s": run.wall_s,
        "initialisation": attempt_entries(run.attempts, _origin_ns(run)),
        "calibration": {name: {"value": found.value, "unit": found.unit} for name, found in run.calibration.items()},
        "counters": {name: int(count) for name, count in run.counters.items()},
        "undefined": cells.undefined,
        "protocol": make_protocol(run, options, "causal", states.stamps_ns).as_dict(),
        "final": None,
    }
    if run.smoothed is not None:
        final = _accuracy(run.smoothed, run.ground_truth, options)
        row["final"] = {
            **final.values,
            "undefined": final.undefined,
            "protocol": make_protocol(run, options, "final", run.smoothed.stamps_ns).as_dict(),
        }
    return row


def _origin_ns(run: SequenceRun) -> int:
    """Where the run began: its first image, or the first attempt to start where no points were counted."""
    if len(run.track_stamps_ns):
        return int(run.track_stamps_ns[0])
    return run.attempts[0].stamp_ns if run.attempts else 0


def make_protocol(run: SequenceRun, options: EvaluationOptions, output: Output, stamps_ns: Stamps) -> Protocol:
    """How the numbers of the poses at ``stamps_ns`` (N,) are measured."""
    return Protocol(
        options=options,
        output=output,
        rate_hz=rate_hz(stamps_ns),
        truth_rate_hz=None if run.ground_truth is None else rate_hz(run.ground_truth.stamps_ns),
        init=run.init,
        uses_ground_truth=run.uses_ground_truth,
        faults=run.faults,
        nees_alignment="none" if run.init == "groundtruth" else "yaw and position at the first tracking state",
    )


def rate_hz(stamps_ns: Stamps) -> float | None:
    """Usual rate of stamps, or None for fewer than two."""
    return NANOSECONDS / float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else None


def match(
    estimate: Trajectory, truth: Trajectory | None, options: EvaluationOptions, *, offset_s: float = 0.0
) -> MatchedPoses:
    """:func:`~vioframe.evaluation.align.associate` with the user's options.

    Raises:
        MetricError: there is no truth, or none at these stamps.
    """
    if truth is None:
        raise MetricError(NO_TRUTH)
    if len(estimate) == 0:
        raise MetricError(NEVER_STARTED)
    farthest = float(np.abs(estimate.T_world_body[:, :3, 3]).max())
    if farthest > FARTHEST_M:
        raise MetricError(f"the estimate has diverged: a position is {farthest:.2g} m from the origin")
    return associate(
        estimate,
        truth,
        method=options.association,
        max_gap_s=options.max_gap_s,
        max_difference_s=options.max_difference_s,
        offset_s=offset_s,
    )


def compare_trajectories(
    estimate: Trajectory, truth: Trajectory, options: EvaluationOptions, *, alignment: Alignment, offset_s: float = 0.0
) -> Row:
    """The metrics of two trajectories from anywhere, for ``task=evaluate``.

    Args:
        estimate, truth: on one clock, up to ``offset_s``.
        options: association and segments.
        alignment: of ``ate_m``; with ``sim3`` the estimate is scaled before any other error is taken, and only
            with ``yaw``, which says that both worlds have z up, there are errors of yaw and gravity.
        offset_s: added to the stamps of the estimate.

    Raises:
        MetricError: nothing matches.
    """
    matched = match(estimate, truth, options, offset_s=offset_s)
    cells = _accuracy(estimate, truth, options, offset_s=offset_s, scaled=alignment == "sim3")
    asked = ("ate_m", "ate_mean_m", "ate_median_m", "ate_max_m")
    cells.add(asked, lambda: _statistics(matched, alignment))
    # In the worlds of these files z may point anywhere.
    upright = ("ate_yaw_m", "yaw_rmse_deg", "gravity_rmse_deg", "gravity_max_deg")
    names = [name for name in cells.values if alignment == "yaw" or name not in upright]
    leading = ("path_estimated_m", "poses", "path_m", *asked)
    values = {name: cells.values[name] for name in (*leading, *names)}
    return {**values, "undefined": {name: reason for name, reason in cells.undefined.items() if name in values}}


def _accuracy(
    estimate: Trajectory,
    truth: Trajectory | None,
    options: EvaluationOptions,
    *,
    offset_s: float = 0.0,
    scaled: bool = False,
) -> _Cells:
    """Every metric that two trajectories suffice for; ``scaled`` brings relative errors to the scale of the truth."""
    cells = _Cells()
    reason, matched = "", None
    try:
        matched = match(estimate, truth, options, offset_s=offset_s)
    except MetricError as error:
        reason = str(error)

    def add(names: Sequence[str], compute: Callable[[MatchedPoses], Sequence[float]]) -> None:
        if matched is None:
            cells.refuse(names, reason)
        else:
            cells.add(names, lambda: compute(matched))

    cells.add(["path_estimated_m"], lambda: [path_length(estimate.T_world_body)])
    cells.values["poses"] = 0 if matched is None else len(matched)
    add(["path_m"], lambda m: [m.path_m])
    add(["ate_se3_m", "ate_se3_mean_m", "ate_se3_median_m", "ate_se3_max_m"], lambda m: _statistics(m, "se3"))
    add(["ate_se3_percent"], _ate_percent)
    add(["ate_yaw_m"], lambda m: [metrics.absolute_error(m, "yaw")[0].rmse])
    add(["ate_sim3_m", "sim3_scale"], _sim3)
    add(["scale_error_percent"], lambda m: [metrics.scale_error_percent(_sim3(m)[1])])

    def add_relative(names: Sequence[str], compute: Callable[[MatchedPoses], Sequence[float]]) -> None:
        add(names, lambda m: compute(_scaled(m) if scaled else m))

    for distance in options.rpe_distances_m:
        add_relative(
            [f"rpe_trans_percent_{distance:g}m", f"rpe_rot_deg_{distance:g}m"],
            partial(_rpe_by_distance, distance_m=distance),
        )
    for duration in options.rpe_times_s:
        add_relative(
            [f"rpe_trans_m_{duration:g}s", f"rpe_rot_deg_{duration:g}s"],
            partial(_rpe_by_time, duration_s=duration),
        )
    by_length: dict[str, dict[str, float | int]] = {}

    def drift(poses: MatchedPoses) -> list[float]:
        errors = metrics.segment_errors(poses, options.segment_lengths_m, options.segment_step)
        by_length.update(errors.by_length())
        return [errors.t_rel_percent, errors.r_rel_deg_per_100m]

    add_relative(["t_rel_percent", "r_rel_deg_per_100m"], drift)
    add(["yaw_rmse_deg"], lambda m: [_rms_deg(metrics.yaw_errors(m))])
    add(["gravity_rmse_deg", "gravity_max_deg"], _gravity)
    cells.values["segments"] = {} if cells.values["t_rel_percent"] is None else by_length
    return cells


def _scaled(matched: MatchedPoses) -> MatchedPoses:
    """The estimate laid over the truth by Sim(3).

    Raises:
        MetricError: the positions do not determine it.
    """
    return replace(matched, T_estimate=align(matched, "sim3").apply(matched.T_estimate))


def _statistics(matched: MatchedPoses, alignment: Alignment) -> list[float]:
    error = metrics.absolute_error(matched, alignment)[0]
    return [error.rmse, error.mean, error.median, error.maximum]


def _ate_percent(matched: MatchedPoses) -> list[float]:
    path_m = matched.path_m
    if path_m < 1.0:
        raise MetricError(f"the path is {path_m:.2g} m long: a percentage of it would say nothing")
    return [100.0 * metrics.absolute_error(matched, "se3")[0].rmse / path_m]


def _sim3(matched: MatchedPoses) -> list[float]:
    error, motion = metrics.absolute_error(matched, "sim3")
    return [error.rmse, motion.scale]


def _rpe_by_distance(matched: MatchedPoses, distance_m: float) -> list[float]:
    error = metrics.relative_error_by_distance(matched, distance_m)
    return [error.trans_percent or 0.0, error.rot_deg]


def _rpe_by_time(matched: MatchedPoses, duration_s: float) -> list[float]:
    error = metrics.relative_error_by_time(matched, duration_s)
    return [error.trans_m, error.rot_deg]


def _gravity(matched: MatchedPoses) -> list[float]:
    errors = metrics.gravity_errors(matched)
    return [_rms_deg(errors), float(np.rad2deg(errors.max()))]


def _rms_deg(radians: np.ndarray) -> float:
    return float(np.rad2deg(np.sqrt(np.mean(radians**2))))


def _add_consistency(cells: _Cells, states: StateColumns, run: SequenceRun, options: EvaluationOptions) -> None:
    names = ["anees_position", "anees_orientation", "anees_pose"]
    if not np.isfinite(states.covariance).any():
        cells.refuse(names, "the fuser gives no covariance" if len(states) else NEVER_STARTED)
        return
    try:
        matched = match(states.trajectory(), run.ground_truth, options)
        motion = metrics.initial_alignment(matched, states, run.init)
    except MetricError as error:
        cells.refuse(names, str(error))
        return
    errors = metrics.state_errors(matched, states, motion)
    counted = errors.tracking.copy()
    if run.init != "groundtruth":
        # The state that was made to meet the truth has no error of position left.
        counted[int(np.argmax(counted))] = False
    for name, (nees, degrees) in errors.nees().items():
        cells.add([f"anees_{name}"], partial(_average_nees, nees[counted], degrees))


def _average_nees(nees: np.ndarray, degrees: int) -> list[float]:
    return [metrics.average_nees(nees, degrees)]


def _real_time_factor(run: SequenceRun) -> float:
    if run.pipeline_s <= 0.0 or run.windows == 0:
        raise MetricError("no window was processed")
    processed = 1.0
    if run.status != "finished":
        processed = min(run.windows / max(run.frames_expected - 1, 1), 1.0)
    return processed * run.duration_s / run.pipeline_s


def milliseconds_per_frame(run: SequenceRun) -> dict[str, float] | None:
    """Wall milliseconds a window by part, ``framework`` (outside the parts' own methods) and ``total``."""
    if run.windows == 0:
        return None
    per_window = 1e3 / run.windows
    table = {part: seconds * per_window for part, seconds in run.parts_s.items()}
    table["framework"] = max(run.pipeline_s - sum(run.parts_s.values()), 0.0) * per_window
    table["total"] = run.pipeline_s * per_window
    return table


def metrics_document(
    rows: Sequence[Row], options: EvaluationOptions, extra: Mapping[str, object] | None = None
) -> dict[str, object]:
    """What ``metrics.json`` holds: an interface others script against.

    Args:
        rows: one per sequence.
        options: what all rows share.
        extra: further top-level entries, such as the choice of parts and the version.
    """
    return {"sequences": list(rows), "protocol": describe_options(options), **(extra or {})}
