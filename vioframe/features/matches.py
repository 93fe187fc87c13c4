"""Whether descriptors tell points apart: average precision of nearest neighbours, and matching score."""

import numpy as np

from vioframe.checks import Array


def average_precision(distance: Array, apart: Array, correct_px: float, max_distance: float | None = None) -> float:
    """Area under the precision-recall curve of nearest neighbours, the mean of both directions (NN mAP).

    DeTone et al. 2018 (SuperPoint, section 7.3) name the metric; this is how it is taken here. Every point of one
    picture proposes its nearest neighbour by descriptor in the other; proposals are ranked by the distance of the
    descriptors, and one is right where the points are at most ε apart. With P points that have a point of the other
    picture within ε at all, t_k right ones among the first n_k proposals after the k-th distinct distance,

        AP = Σ_k (t_k − t_{k−1}) / P · t_k / n_k,

    no interpolation, proposals of equal distance taken together (bits have many). The mean over pairs of pictures is
    the mAP.

    Args:
        distance: (M, K) of the descriptors.
        apart: (M, K) px of the points.
        correct_px: ε.
        max_distance: neighbours further than this are not proposed.

    Returns:
        between 0 and 1; 0 where no point has a counterpart or nothing is proposed.
    """
    directions = [_one_way(d, a, correct_px, max_distance) for d, a in ((distance, apart), (distance.T, apart.T))]
    return float(np.mean(directions))


def _one_way(distance: Array, apart: Array, correct_px: float, max_distance: float | None) -> float:
    possible = int(np.count_nonzero(apart.min(axis=1, initial=np.inf) <= correct_px))
    if possible == 0:
        return 0.0
    rows = np.arange(len(distance))
    nearest = distance.argmin(axis=1)
    far = distance[rows, nearest]
    right = apart[rows, nearest] <= correct_px
    order = np.argsort(far, kind="stable")
    if max_distance is not None:
        order = order[far[order] <= max_distance]
    far, right = far[order], right[order]
    last_of_equals = np.flatnonzero(np.append(far[1:] != far[:-1], len(far) > 0))
    found = np.cumsum(right)[last_of_equals]
    precision = found / (last_of_equals + 1)
    return float(np.sum(np.diff(found, prepend=0) * precision) / possible)


def matching_score(correct: int, counts: tuple[int, int]) -> float:
    """Correct matches as a share of the points in the area that both pictures show, the mean of both pictures.

    DeTone et al. 2018, section 7.3: what the whole pipeline recovers of what it proposed. Its matches are mutual
    nearest neighbours here, the same that the homography is estimated from.

    Args:
        correct: matches whose points are at most ε apart.
        counts: points of the first picture and of the second; 0 points give a share of 0.
    """
    return float(np.mean([correct / count if count else 0.0 for count in counts]))
