"""Whether a detector finds the same points again: repeatability and localisation error."""

from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.pictures.homographies import warp_points


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Repetition:
    """Points of two pictures that are the same point of the scene.

    Attributes:
        first: (M,) which points of the first picture were found again.
        second: (K,) of the second.
        repeatability: share of all points of both that were; 0 where there are none.
        localisation_px: mean distance of those that were from their nearest neighbours, or None.
    """

    first: Mask
    second: Mask
    repeatability: float
    localisation_px: float | None


def distances_px(first: Array, second: Array, H_second_first: Array) -> Array:
    """Distances (M, K) px, in the second picture, of points (M, 2) of the first from points (K, 2) of the second."""
    warped = warp_points(first, H_second_first)
    apart: Array = np.linalg.norm(warped[:, None] - second, axis=-1)
    # What the homography sends to infinity is near nothing.
    return np.where(np.isnan(apart), np.inf, apart)


def repetition(apart: Array, correct_px: float) -> Repetition:
    """Repeatability and localisation error, as DeTone et al. 2018 (SuperPoint, section 7.2 and appendix) define them.

    A point x of one picture is found again where the nearest point of the other is at most ε away:

        Corr(x) = [ min_j ‖x̂ − x̂_j‖ ≤ ε ],   Rep = (Σ_i Corr(x_i) + Σ_j Corr(x_j)) / (N₁ + N₂),

        LE = mean of min_j ‖x̂ − x̂_j‖ over all x of both pictures with Corr(x).

    All distances are taken in the second picture. N₁ and N₂ count the points of the area that both pictures show. A
    pair without any points counts as 0, not as absent: a detector that goes blind in the dark shall not gain by it.

    Args:
        apart: (M, K) from :func:`distances_px`.
        correct_px: ε.
    """
    of_first = apart.min(axis=1, initial=np.inf)
    of_second = apart.min(axis=0, initial=np.inf)
    first, second = of_first <= correct_px, of_second <= correct_px
    nearest = np.concatenate([of_first[first], of_second[second]])
    count = len(first) + len(second)
    return Repetition(
        first=first,
        second=second,
        repeatability=len(nearest) / count if count else 0.0,
        localisation_px=float(nearest.mean()) if len(nearest) else None,
    )
