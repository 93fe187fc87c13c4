"""How good predicted motions are on the validation recordings: t_rel and r_rel of the trajectories they make.

Beside them stands a reference on the same segments: what a predictor without eyes reaches, the mean motion of the
training recordings, always; for a fuser, the VO alone. Checkpoints are ranked by both errors relative to it, which
weighs metres against degrees by how hard each is on the data at hand: ½ (t_rel / t_rel of it + r_rel / r_rel of it).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.data.windows import StoredSequence
from vioframe.errors import DataError, MetricError
from vioframe.evaluation.align import MatchedPoses
from vioframe.evaluation.metrics import segment_errors
from vioframe.geometry import se3, so3

# On a straight road constant motion has next to no rotation error, and nothing should be measured in units of nothing.
# These are about what the better learned odometers reach on KITTI.
_LEAST_PERCENT = 1.0
_LEAST_DEG_PER_100M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Errors of the camera's trajectory, causal, without alignment.

    Attributes:
        t_rel_percent: mean translation error of all segments, percent of their length.
        r_rel_deg_per_100m: mean rotation error, degrees per 100 m.
        segments: how many there were.
    """

    t_rel_percent: float
    r_rel_deg_per_100m: float
    segments: int

    def relative_to(self, other: "Score") -> float:
        """Mean of both errors in units of another's; less is better."""
        t_rel = self.t_rel_percent / max(other.t_rel_percent, _LEAST_PERCENT)
        r_rel = self.r_rel_deg_per_100m / max(other.r_rel_deg_per_100m, _LEAST_DEG_PER_100M)
        return 0.5 * (t_rel + r_rel)


def mean_motion(sequences: Sequence[StoredSequence]) -> Array:
    """The motion (4, 4) whose tangent is the mean over all pairs of these recordings."""
    tangents = [se3.log(sequence.motions()[sequence.known[:-1] & sequence.known[1:]]) for sequence in sequences]
    return se3.exp(np.concatenate(tangents).mean(axis=0))


def score_motions(
    sequences: Sequence[StoredSequence],
    motions: Sequence[Array],
    answered: Sequence[Mask],
    *,
    lengths_m: Sequence[float],
    step: int,
) -> Score:
    """Chain motions where they follow each other, and measure the segments of each chain.

    Args:
        sequences: the recordings.
        motions: for each, (F - 1, 4, 4) predicted motion of camera 0 over each pair.
        answered: for each, (F - 1,) where there is a prediction.
        lengths_m: of the segments, along the truth.
        step: images from the start of a segment to that of the next.

    Raises:
        DataError: no segment fits on any recording.
    """
    trans: list[Array] = []
    rot: list[Array] = []
    reason = "nothing was predicted"
    for sequence, predicted, usable in zip(sequences, motions, answered, strict=True):
        pairs = np.flatnonzero(usable & sequence.known[:-1] & sequence.known[1:])
        for run in np.split(pairs, np.flatnonzero(np.diff(pairs) != 1) + 1):
            if len(run) == 0:
                continue
            T_truth = sequence.T_world_cam[run[0] : run[-1] + 2]
            stamps = sequence.stamps_ns[run[0] : run[-1] + 2]
            numbers = np.arange(len(T_truth))
            matched = MatchedPoses(
                stamps_ns=stamps,
                T_estimate=chain(predicted[run], T_truth[0]),
                T_truth=T_truth,
                estimate_index=numbers,
                frames=numbers,
                T_truth_frames=T_truth,
            )
            try:
                errors = segment_errors(matched, lengths_m, step)
            except MetricError as error:
                reason = str(error)
                continue
            trans.append(errors.trans)
            rot.append(errors.rot)
    if not trans:
        raise DataError(
            f"the validation recordings are too short to be scored ({reason}): give longer ones, or make "
            "trainer.segment_lengths_m shorter"
        )
    return Score(
        t_rel_percent=_mean(100.0 * np.concatenate(trans)),
        r_rel_deg_per_100m=_mean(100.0 * np.rad2deg(np.concatenate(rot))),
        segments=sum(len(part) for part in trans),
    )


def chain(motions: Array, T_first: Array) -> Array:
    """Poses (K + 1, 4, 4) from motions (K, 4, 4), the first given; rotations are kept orthonormal."""
    if not np.isfinite(motions).all():
        return np.full((len(motions) + 1, 4, 4), np.nan)
    clean = motions.astype(float)
    clean[:, :3, :3] = so3.normalise(clean[:, :3, :3])
    return np.array(list(itertools.accumulate(clean, lambda pose, motion: pose @ motion, initial=T_first)))


def _mean(errors: Array) -> float:
    mean = float(errors.mean())
    return mean if math.isfinite(mean) else math.inf
