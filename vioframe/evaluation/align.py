"""Which poses of an estimate and of the truth belong together, and the motion that lays one over the other.

An odometry has no say in where its world begins (four degrees of freedom with gravity, six without, seven
without scale), so errors are measured after the best such motion has been applied to the estimate.

Least squares over positions: Umeyama, "Least-squares estimation of transformation parameters between two
point patterns", 1991; about the vertical only: Zhang & Scaramuzza, "A tutorial on quantitative trajectory
evaluation", 2018, section III.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ConfigError, MetricError
from vioframe.geometry import se3, so3
from vioframe.types import Trajectory

Alignment = Literal["se3", "yaw", "sim3", "none"]
AssociationMethod = Literal["interpolate", "nearest"]

ALIGNMENTS: dict[str, str] = {
    "se3": "SE(3)",
    "yaw": "yaw and position",
    "sim3": "Sim(3)",
    "none": "no",
}
"""How each alignment is called in print."""

# Positions on a line leave the turn about it open; real paths are never straighter than this, generated ones are.
_LINE_RATIO = 1e-6
# Below this spread of positions (m) there is nothing to align.
_POINT_SPREAD_M = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchedPoses:
    """Poses of an estimate and of the truth at the same instants.

    Attributes:
        stamps_ns: (M,) of the estimate.
        T_estimate: (M, 4, 4) T_world_body in the estimate's world.
        T_truth: (M, 4, 4) T_world_body in the truth's world.
        estimate_index: (M,) which pose of the estimate each one is.
        frames: (M,) number of each pose among ``T_truth_frames``.
        T_truth_frames: (F, 4, 4) the truth at every frame, also those without an estimate, where the two files
            share their frames (KITTI); else just ``T_truth``.
    """

    stamps_ns: Stamps
    T_estimate: Array
    T_truth: Array
    estimate_index: Stamps
    frames: Stamps
    T_truth_frames: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def path_m(self) -> float:
        """Length of the truth over the matched poses."""
        return path_length(self.T_truth)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """Lays the estimate over the truth: ``p_truth = scale · R p_estimate + t``.

    Attributes:
        R: (3, 3), from the estimate's world into the truth's.
        t: (3,) m, in the truth's world.
        scale: metres of the truth per metre of the estimate.
    """

    R: Array
    t: Array
    scale: float = 1.0

    def apply(self, T_world_body: Array) -> Array:
        """Poses (..., 4, 4) of the estimate in the world of the truth."""
        rotation = self.R @ T_world_body[..., :3, :3]
        position = self.scale * T_world_body[..., :3, 3] @ self.R.T + self.t
        return se3.from_parts(rotation, position)

    @staticmethod
    def identity() -> "Motion":
        """No motion."""
        return Motion(R=np.eye(3), t=np.zeros(3))


def path_length(T_world_body: Array) -> float:
    """Metres along the positions of (N, 4, 4)."""
    return float(np.linalg.norm(np.diff(T_world_body[:, :3, 3], axis=0), axis=1).sum())


def associate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    method: AssociationMethod = "interpolate",
    max_gap_s: float = 0.11,
    max_difference_s: float = 0.01,
    offset_s: float = 0.0,
) -> MatchedPoses:
    """Find what the truth was at the stamps of the estimate.

    Args:
        estimate, truth: on one clock, up to ``offset_s``.
        method: ``interpolate`` takes the truth between its two neighbours; ``nearest`` pairs each pose of the
            sparser trajectory with the nearest of the other, as ``evo`` does.
        max_gap_s: ``interpolate`` bridges no longer hole of the truth than this.
        max_difference_s: ``nearest`` pairs no stamps further apart than this.
        offset_s: added to the stamps of the estimate.

    Raises:
        MetricError: nothing matches; says how the two spans lie.
    """
    if method not in ("interpolate", "nearest"):
        raise ConfigError(f"association must be interpolate or nearest, got {method!r}")
    if len(estimate) == 0 or len(truth) == 0:
        raise MetricError(f"{'the estimate' if len(estimate) == 0 else 'the ground truth'} has no poses")
    stamps_ns = estimate.stamps_ns + round(offset_s * NANOSECONDS)
    if method == "nearest":
        estimate_index, truth_index = _nearest(stamps_ns, truth.stamps_ns, round(max_difference_s * NANOSECONDS))
        T_truth = truth.T_world_body[truth_index]
        limit = f"within {max_difference_s:g} s of each other"
    else:
        T_truth, estimate_index = _interpolated(truth, stamps_ns, round(max_gap_s * NANOSECONDS))
        truth_index = np.searchsorted(truth.stamps_ns, stamps_ns[estimate_index])
        truth_index = np.minimum(truth_index, len(truth) - 1)
        limit = f"with ground truth on both sides at most {max_gap_s:g} s apart"
    if len(estimate_index) == 0:
        raise MetricError(
            f"no pose of the estimate ({_span(stamps_ns)}) has a pose of the ground truth "
            f"({_span(truth.stamps_ns)}) {limit}"
        )
    stamps_ns = stamps_ns[estimate_index]
    shared = bool((truth.stamps_ns[truth_index] == stamps_ns).all()) and _same_rate(estimate.stamps_ns, truth.stamps_ns)
    return MatchedPoses(
        stamps_ns=stamps_ns,
        T_estimate=estimate.T_world_body[estimate_index],
        T_truth=T_truth,
        estimate_index=estimate_index,
        frames=truth_index if shared else np.arange(len(stamps_ns)),
        T_truth_frames=truth.T_world_body if shared else T_truth,
    )


def _span(stamps_ns: Stamps) -> str:
    return f"{stamps_ns[0] / NANOSECONDS:.3f} to {stamps_ns[-1] / NANOSECONDS:.3f} s"


def _same_rate(first: Stamps, second: Stamps) -> bool:
    if min(len(first), len(second)) < 2:
        return False
    return bool(abs(np.median(np.diff(first)) / np.median(np.diff(second)) - 1.0) < 0.01)


def _nearest(first: Stamps, second: Stamps, max_difference_ns: int) -> tuple[Stamps, Stamps]:
    """Index pairs; each stamp of the sparser with the nearest of the other."""
    swap = len(second) < len(first)
    sparse, dense = (second, first) if swap else (first, second)
    after = np.clip(np.searchsorted(dense, sparse, side="left"), 0, len(dense) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(sparse - dense[before]) <= np.abs(dense[after] - sparse), before, after)
    close = np.abs(dense[nearest] - sparse) <= max_difference_ns
    pairs = np.flatnonzero(close), nearest[close]
    return (pairs[1], pairs[0]) if swap else pairs


def _interpolated(truth: Trajectory, stamps_ns: Stamps, max_gap_ns: int) -> tuple[Array, Stamps]:
    """The truth at those stamps that it covers, and which they are."""
    from vioframe.geometry.interpolation import interpolate_poses

    if len(truth) == 1:
        covered = np.flatnonzero(stamps_ns == truth.stamps_ns[0])
        return np.repeat(truth.T_world_body, len(covered), axis=0), covered
    T_truth, known = interpolate_poses(truth, stamps_ns, max_gap_ns=max_gap_ns)
    index = np.flatnonzero(known)
    return T_truth[index], index


def align(matched: MatchedPoses, alignment: Alignment) -> Motion:
    """The motion that lays the estimate over the truth, in least squares over all matched positions.

    Raises:
        MetricError: the positions do not determine it; says why.
    """
    estimate, truth = matched.T_estimate[:, :3, 3], matched.T_truth[:, :3, 3]
    if alignment == "none":
        return Motion.identity()
    if alignment == "yaw":
        return align_yaw(estimate, truth)
    if alignment in ("se3", "sim3"):
        return align_umeyama(estimate, truth, with_scale=alignment == "sim3")
    raise ConfigError(f"alignment must be one of {', '.join(ALIGNMENTS)}, got {alignment!r}")


def align_umeyama(estimate: Array, truth: Array, *, with_scale: bool) -> Motion:
    """SE(3) or Sim(3) from positions (M, 3) of the same instants.

    Raises:
        MetricError: fewer than three positions, or they coincide or lie on one line.
    """
    name = "Sim(3)" if with_scale else "SE(3)"
    if len(estimate) < 3:
        raise MetricError(f"{name} alignment needs 3 poses, but {len(estimate)} match")
    for whose, points in (("estimate", estimate), ("ground truth", truth)):
        _check_spread(name, whose, points)
    mean_estimate, mean_truth = estimate.mean(axis=0), truth.mean(axis=0)
    from_mean = estimate - mean_estimate
    u, singular, vt = np.linalg.svd((truth - mean_truth).T @ from_mean)
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    R = (u * proper) @ vt
    scale = float((singular * proper).sum() / (from_mean**2).sum()) if with_scale else 1.0
    return Motion(R=R, t=mean_truth - scale * R @ mean_estimate, scale=scale)


def _check_spread(name: str, whose: str, points: Array) -> None:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if spread[0] < _POINT_SPREAD_M:
        raise MetricError(f"{name} alignment: all positions of the {whose} coincide, so no rotation can be found")
    if spread[1] < _LINE_RATIO * spread[0]:
        raise MetricError(
            f"{name} alignment: the positions of the {whose} lie on one line, so the rotation about it is open; "
            "yaw alignment does not need it"
        )


def align_yaw(estimate: Array, truth: Array) -> Motion:
    """Rotation about z and translation from positions (M, 3); both worlds have z up.

    Raises:
        MetricError: fewer than two positions, or no horizontal motion.
    """
    if len(estimate) < 2:
        raise MetricError(f"yaw alignment needs 2 poses, but {len(estimate)} match")
    for whose, points in (("estimate", estimate), ("ground truth", truth)):
        if np.std(points[:, :2], axis=0).max() < _POINT_SPREAD_M:
            raise MetricError(f"yaw alignment: the {whose} does not move horizontally, so no yaw can be found")
    mean_estimate, mean_truth = estimate.mean(axis=0), truth.mean(axis=0)
    a, b = estimate - mean_estimate, truth - mean_truth
    sine = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    cosine = (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]).sum()
    R = so3.rotation_z(np.arctan2(sine, cosine))
    return Motion(R=R, t=mean_truth - R @ mean_estimate)


def align_first(T_estimate: Array, T_truth: Array) -> Motion:
    """Yaw and position that make one pose (4, 4) meet the truth: what an odometry with gravity is free to choose.

    The yaw taken is the rotation about z nearest to ``R_truth R_estimateᵀ``, which leaves a tilt untouched.
    """
    turn = T_truth[:3, :3] @ T_estimate[:3, :3].T
    R = so3.rotation_z(yaw_of(turn))
    return Motion(R=R, t=T_truth[:3, 3] - R @ T_estimate[:3, 3])


def yaw_of(R: Array) -> Array:
    """Angle (...) rad of the rotation about z nearest to R (..., 3, 3), in the Frobenius norm."""
    yaw: Array = np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1])
    return yaw
