"""Errors of a trajectory against the truth.

Every function refuses with :class:`MetricError` where its number would mean nothing; the message is the
reason that the table and ``metrics.json`` give.

References: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012 (ATE, RPE); Geiger et
al., "Are we ready for autonomous driving?", 2012, and the KITTI odometry devkit (t_rel, r_rel); Bar-Shalom et
al., "Estimation with Applications to Tracking and Navigation", 2001, section 5.4 (NEES).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.errors import MetricError
from vioframe.evaluation.align import Alignment, MatchedPoses, Motion, align, align_first, yaw_of
from vioframe.evaluation.states import StateColumns
from vioframe.geometry import se3, so3

# A pair for the RPE by distance may be this much longer than asked, where poses are sparse or missing.
_MAX_OVERSHOOT = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorStatistics:
    """Of position errors, in metres."""

    rmse: float
    mean: float
    median: float
    maximum: float
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativeError:
    """Root mean square error of relative poses.

    Attributes:
        trans_m: metres.
        trans_percent: percent of the true length of each pair; None where that may be zero.
        rot_deg: degrees.
        pairs: how many.
    """

    trans_m: float
    trans_percent: float | None
    rot_deg: float
    pairs: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentErrors:
    """One entry per segment of the KITTI metric.

    Attributes:
        start: (S,) number of the first frame.
        length_m: (S,) nominal length along the truth.
        trans: (S,) metres per metre.
        rot: (S,) rad per metre.
    """

    start: np.ndarray
    length_m: Array
    trans: Array
    rot: Array

    @property
    def t_rel_percent(self) -> float:
        """Mean translation error, percent."""
        return 100.0 * float(self.trans.mean())

    @property
    def r_rel_deg_per_100m(self) -> float:
        """Mean rotation error, degrees per 100 m."""
        return 100.0 * float(np.rad2deg(self.rot.mean()))

    def by_length(self) -> dict[str, dict[str, float | int]]:
        """Count and means for each length that occurs."""
        table: dict[str, dict[str, float | int]] = {}
        for length in np.unique(self.length_m):
            of_length = self.length_m == length
            table[f"{length:g}"] = {
                "segments": int(of_length.sum()),
                "t_rel_percent": 100.0 * float(self.trans[of_length].mean()),
                "r_rel_deg_per_100m": 100.0 * float(np.rad2deg(self.rot[of_length].mean())),
            }
        return table


def position_errors(matched: MatchedPoses, motion: Motion) -> Array:
    """Estimate less truth (M, 3) m in the world of the truth."""
    errors: Array = motion.apply(matched.T_estimate)[:, :3, 3] - matched.T_truth[:, :3, 3]
    return errors


def absolute_error(matched: MatchedPoses, alignment: Alignment) -> tuple[ErrorStatistics, Motion]:
    """ATE: position errors after the alignment, and the alignment found.

    Raises:
        MetricError: the alignment is not determined.
    """
    motion = align(matched, alignment)
    distance = np.linalg.norm(position_errors(matched, motion), axis=1)
    statistics = ErrorStatistics(
        rmse=_root_mean_square(distance),
        mean=float(distance.mean()),
        median=float(np.median(distance)),
        maximum=float(distance.max()),
        count=len(distance),
    )
    return statistics, motion


def scale_error_percent(scale: float) -> float:
    """By how much the estimate is too large, for the scale (truth per estimate) of a Sim(3) alignment.

    Raises:
        MetricError: the estimate runs against the truth, so no positive scale fits.
    """
    if scale <= 0.0:
        raise MetricError(f"the scale of the Sim(3) alignment is {scale:.3g}: estimate and truth do not correlate")
    return 100.0 * (1.0 / scale - 1.0)


def relative_error_by_distance(matched: MatchedPoses, distance_m: float) -> RelativeError:
    """RPE over all pairs whose truth runs ``distance_m`` along the path.

    Raises:
        MetricError: no such pair.
    """
    along = _distance_along(matched.T_truth)
    # The path adds up in floating point: a pair of exactly that length must not be missed for a rounding error.
    end = np.searchsorted(along, along + distance_m * (1.0 - 1e-9), side="left")
    start = np.flatnonzero(end < len(along))
    end = end[start]
    length = along[end] - along[start]
    kept = length <= (1.0 + _MAX_OVERSHOOT) * distance_m
    if not kept.any():
        reason = "the poses are too sparse" if len(start) else f"the path is {along[-1]:.1f} m long"
        raise MetricError(f"no pair of poses {distance_m:g} m apart along the path: {reason}")
    return _relative_error(matched, start[kept], end[kept], length[kept])


def relative_error_by_time(matched: MatchedPoses, duration_s: float) -> RelativeError:
    """RPE over all pairs ``duration_s`` apart, to within half the usual interval between poses.

    Raises:
        MetricError: no such pair.
    """
    stamps = matched.stamps_ns
    if len(stamps) < 2:
        raise MetricError(f"no pair of poses {duration_s:g} s apart: {len(stamps)} match the ground truth")
    wanted = stamps + round(duration_s * NANOSECONDS)
    after = np.clip(np.searchsorted(stamps, wanted), 1, len(stamps) - 1)
    end = np.where(wanted - stamps[after - 1] < np.abs(stamps[after] - wanted), after - 1, after)
    close = np.abs(stamps[end] - wanted) <= 0.5 * np.median(np.diff(stamps))
    start = np.flatnonzero(close & (end > np.arange(len(stamps))))
    if len(start) == 0:
        span = (stamps[-1] - stamps[0]) / NANOSECONDS
        raise MetricError(f"no pair of poses {duration_s:g} s apart: the poses span {span:.1f} s")
    return _relative_error(matched, start, end[start], None)


def _relative_error(matched: MatchedPoses, start: np.ndarray, end: np.ndarray, length_m: Array | None) -> RelativeError:
    estimate, truth = matched.T_estimate, matched.T_truth
    error = _pair_errors(estimate[start], estimate[end], truth[start], truth[end])
    trans = np.linalg.norm(error[:, :3, 3], axis=1)
    return RelativeError(
        trans_m=_root_mean_square(trans),
        trans_percent=None if length_m is None else 100.0 * _root_mean_square(trans / length_m),
        rot_deg=float(np.rad2deg(_root_mean_square(so3.angle(error[:, :3, :3])))),
        pairs=len(start),
    )


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _pair_errors(T_estimate_0: Array, T_estimate_1: Array, T_truth_0: Array, T_truth_1: Array) -> Array:
    """(estimated motion)⁻¹ (true motion), (S, 4, 4)."""
    return se3.inverse(se3.inverse(T_estimate_0) @ T_estimate_1) @ (se3.inverse(T_truth_0) @ T_truth_1)


def _distance_along(T_truth: Array) -> Array:
    steps = np.linalg.norm(np.diff(T_truth[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])[: len(T_truth)]


def segment_errors(
    matched: MatchedPoses, lengths_m: Sequence[float], step: int, motion: Motion | None = None
) -> SegmentErrors:
    """KITTI's segment errors, as the devkit computes them.

    A segment begins at every ``step``-th frame and ends at the first frame that lies *more* than its length
    further along the truth; its errors are divided by the nominal length. Segments with an end for which
    there is no estimate are left out.

    Args:
        matched: poses; the frames are those of ``matched.T_truth_frames``.
        lengths_m: lengths along the truth.
        step: frames from one start to the next.
        motion: alignment to apply first; only its scale makes a difference.

    Raises:
        MetricError: no segment fits on the path.
    """
    along = _distance_along(matched.T_truth_frames)
    pose_of_frame = np.full(len(along), -1)
    pose_of_frame[matched.frames] = np.arange(len(matched))
    T_estimate = matched.T_estimate if motion is None else motion.apply(matched.T_estimate)
    T_truth = matched.T_truth_frames
    first = np.arange(0, len(along), step)
    starts, ends, lengths = [], [], []
    for length in lengths_m:
        last = np.searchsorted(along, along[first] + length, side="right")
        fits = last < len(along)
        fits[fits] = (pose_of_frame[first[fits]] >= 0) & (pose_of_frame[last[fits]] >= 0)
        starts.append(first[fits])
        ends.append(last[fits])
        lengths.append(np.full(int(fits.sum()), float(length)))
    start, end, length_m = np.concatenate(starts), np.concatenate(ends), np.concatenate(lengths)
    if len(start) == 0:
        shortest = min(lengths_m, default=0.0)
        raise MetricError(f"no segment of {shortest:g} m fits on the {matched.path_m:.1f} m of path that were compared")
    error = _pair_errors(T_estimate[pose_of_frame[start]], T_estimate[pose_of_frame[end]], T_truth[start], T_truth[end])
    return SegmentErrors(
        start=start,
        length_m=length_m,
        trans=np.linalg.norm(error[:, :3, 3], axis=1) / length_m,
        rot=so3.angle(error[:, :3, :3]) / length_m,
    )


def yaw_errors(matched: MatchedPoses) -> Array:
    """Error about the vertical (M,) rad, less its circular mean: no yaw is known at the start."""
    yaw = yaw_of(matched.T_estimate[:, :3, :3] @ np.swapaxes(matched.T_truth[:, :3, :3], -1, -2))
    mean = np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean())
    errors: Array = np.mod(yaw - mean + np.pi, 2.0 * np.pi) - np.pi
    return errors


def gravity_errors(matched: MatchedPoses) -> Array:
    """Angle (M,) rad between the true and the estimated vertical, both seen from the body."""
    up_estimate, up_truth = matched.T_estimate[:, 2, :3], matched.T_truth[:, 2, :3]
    sine = np.linalg.norm(np.cross(up_estimate, up_truth), axis=1)
    angle: Array = np.arctan2(sine, np.sum(up_estimate * up_truth, axis=1))
    return angle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateErrors:
    """Errors of states with their covariance, in the world of the truth.

    Attributes:
        stamps_ns: (K,).
        theta: (K, 3) rad, local: ``R_truth = R_estimate Exp(θ)``.
        position: (K, 3) m, truth less estimate.
        covariance: (K, 6, 6), order (θ, p), p in the world of the truth.
        tracking: (K,) whether the status was tracking.
    """

    stamps_ns: Stamps
    theta: Array
    position: Array
    covariance: Array
    tracking: np.ndarray

    def nees(self) -> dict[str, tuple[Array, int]]:
        """Normalised errors (K,) of position, orientation and both, each with its degrees of freedom."""
        both = np.concatenate([self.theta, self.position], axis=1)
        return {
            "position": (normalised_errors(self.position, self.covariance[:, 3:, 3:]), 3),
            "orientation": (normalised_errors(self.theta, self.covariance[:, :3, :3]), 3),
            "pose": (normalised_errors(both, self.covariance), 6),
        }


def initial_alignment(matched: MatchedPoses, states: StateColumns, init: str) -> Motion:
    """What an odometry with gravity may choose freely, fixed at the first state with status tracking.

    A fuser that starts itself puts its world where it likes in yaw and position, and is certain of it: its
    covariance there is that of the motion since. So the two worlds are made to meet in these four degrees of
    freedom at that one state, and in nothing else. One that was started from the truth (``init``
    ``"groundtruth"``) already lives in its world; then nothing is aligned.

    Args:
        matched: poses of ``states``.
        states: what ``matched.estimate_index`` refers to.
        init: as in :class:`~vioframe.evaluation.run.SequenceRun`.

    Raises:
        MetricError: no state with status tracking has a ground truth.
    """
    if init == "groundtruth":
        return Motion.identity()
    tracking = np.flatnonzero(states.status[matched.estimate_index] == "tracking")
    if len(tracking) == 0:
        raise MetricError("no state with status tracking has a ground truth")
    return align_first(matched.T_estimate[tracking[0]], matched.T_truth[tracking[0]])


def state_errors(matched: MatchedPoses, states: StateColumns, motion: Motion) -> StateErrors:
    """Errors of all matched states after ``motion``, which turns the covariance of p with it.

    The covariance is NaN where a state has none.
    """
    T_estimate = motion.apply(matched.T_estimate)
    turn = np.eye(6)
    turn[3:, 3:] = motion.R
    return StateErrors(
        stamps_ns=matched.stamps_ns,
        theta=so3.log(np.swapaxes(T_estimate[:, :3, :3], -1, -2) @ matched.T_truth[:, :3, :3]),
        position=matched.T_truth[:, :3, 3] - T_estimate[:, :3, 3],
        covariance=turn @ states.covariance[matched.estimate_index] @ turn.T,
        tracking=states.status[matched.estimate_index] == "tracking",
    )


def normalised_errors(errors: Array, covariance: Array) -> Array:
    """NEES (K,): eᵀ P⁻¹ e; NaN where P is not positive definite, as at the very start.

    Args:
        errors: (K, D).
        covariance: (K, D, D).
    """
    nees = np.full(len(errors), np.nan)
    if len(errors) == 0:
        return nees
    # Positive definite is judged free of units, on the correlations.
    deviation = np.sqrt(np.maximum(np.nan_to_num(np.diagonal(covariance, axis1=1, axis2=2)), 0.0))
    positive = np.flatnonzero((deviation > 0.0).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    unit = deviation[positive]
    correlation = covariance[positive] / (unit[:, :, None] * unit[:, None, :])
    definite = np.linalg.eigvalsh(correlation)[:, 0] > 1e-12
    whitened = errors[positive[definite]] / unit[definite]
    solved = np.linalg.solve(correlation[definite], whitened[..., None])[..., 0]
    nees[positive[definite]] = np.sum(whitened * solved, axis=1)
    return nees


def average_nees(nees: Array, degrees: int) -> float:
    """ANEES per degree of freedom: 1 is consistent, more is overconfident.

    Raises:
        MetricError: no covariance to weigh with.
    """
    usable = np.isfinite(nees)
    if not usable.any():
        raise MetricError("no state with status tracking has a ground truth and a positive definite covariance")
    return float(nees[usable].mean()) / degrees
