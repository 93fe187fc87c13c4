"""Random homographies and what they do to points, pictures and masks.

A homography ``H`` maps pixels of a picture to pixels of the warped one: ``x' ~ H (x, y, 1)``. It is drawn by its
inverse: a quadrilateral in the picture that fills the warped picture. Pixels as everywhere: x right, y down, the centre
of the top-left pixel is (0, 0).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from vioframe.checks import Array, Mask
from vioframe.errors import ConfigError
from vioframe.types import Image

_TRIES = 50
# A corner flatter than this squeezes half of the picture into a few pixels.
_SHARPEST_SINE = 0.25
_SMALLEST_AREA = 0.05
_LEAST_DEPTH = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class HomographyOptions:
    """Ranges of random homographies; the defaults are those of SuperPoint's homographic adaptation.

    Attributes:
        patch_ratio: side of the quadrilateral relative to the picture, before anything else; (0, 1].
        perspective: most displacement of its left and right and of its upper and lower corners against each other,
            relative to the picture.
        scale: most relative change of its size.
        max_angle: rad, most rotation either way.
        overflow: how far translation may push it beyond the picture, relative to the picture. Rotation and scale may
            do so in any case.
    """

    patch_ratio: float = 0.85
    perspective: float = 0.2
    scale: float = 0.2
    max_angle: float = float(np.pi / 2)
    overflow: float = 0.05

    def __post_init__(self) -> None:
        if not 0.0 < self.patch_ratio <= 1.0:
            raise ConfigError(f"patch_ratio={self.patch_ratio} of HomographyOptions must lie in (0, 1]")
        for name, value, limit in (
            ("perspective", self.perspective, 0.9),
            ("scale", self.scale, 0.9),
            ("max_angle", self.max_angle, float(np.pi)),
            ("overflow", self.overflow, 1.0),
        ):
            if not 0.0 <= value <= limit:
                raise ConfigError(f"{name}={value} of HomographyOptions must lie in [0, {limit:g}]")


def sample_homography(
    size_px: tuple[int, int], rng: np.random.Generator, options: HomographyOptions | None = None
) -> Array:
    """A random homography (3, 3), ``H[2, 2] = 1``, from pixels of a picture to pixels of the warped one.

    Displacements and the logarithm of the scale are normal with half their range as deviation, cut at the range;
    rotation and translation are uniform.

    Args:
        size_px: (width, height) of both.
        rng: generator.
        options: ranges.
    """
    options = options or HomographyOptions()
    width, height = size_px
    full = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    # Tries end: the last resort is the patch without perspective, which is convex.
    for attempt in range(_TRIES):
        corners = _draw_quadrilateral(size_px, rng, options, flat=attempt == _TRIES - 1)
        H: Array = cv2.getPerspectiveTransform(corners.astype(np.float32), full.astype(np.float32))
        # With the whole picture this side of the horizon, every pixel of it has a place.
        if _is_sound(corners, width * height) and (full @ H[2, :2] + H[2, 2]).min() > _LEAST_DEPTH:
            break
    return H


def _draw_quadrilateral(
    size_px: tuple[int, int], rng: np.random.Generator, options: HomographyOptions, *, flat: bool
) -> Array:
    """Corners (4, 2) px in the picture that become those of the warped one."""
    width, height = size_px
    size = np.array([width - 1.0, height - 1.0])
    middle = 0.5 * size
    half = 0.5 * options.patch_ratio * size
    corners = middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    # Drawn in any case, so that an option at zero does not change the others.
    shift = options.perspective * _cut_normal(rng, 3) * (0.0 if flat else 1.0)
    # One displacement of y for each side, upwards at one end and downwards at the other, is a turn about the vertical
    # axis; one of x for each row leans the plane.
    corners[:, 1] += shift[0] * size[1] * np.array([1, -1, 1, -1])
    corners[:, 0] += size[0] * np.array([shift[1], shift[2], -shift[2], -shift[1]])
    scale = np.exp(np.log1p(options.scale) * float(_cut_normal(rng, 1)[0]))
    centre = corners.mean(axis=0)
    corners = centre + scale * (corners - centre)
    low, high = corners.min(axis=0), corners.max(axis=0)
    least = np.minimum(-low, size - high) - options.overflow * size
    most = np.maximum(-low, size - high) + options.overflow * size
    corners += rng.uniform(least, most)
    angle = rng.uniform(-options.max_angle, options.max_angle)
    cosine, sine = np.cos(angle), np.sin(angle)
    centre = corners.mean(axis=0)
    turned: Array = centre + (corners - centre) @ np.array([[cosine, sine], [-sine, cosine]])
    return turned


def _cut_normal(rng: np.random.Generator, count: int) -> Array:
    """Normal numbers (count,) with deviation 0.5, cut at ±1."""
    return np.clip(0.5 * rng.standard_normal(count), -1.0, 1.0)


def _is_sound(corners: Array, area_px: float) -> bool:
    """Whether a quadrilateral (4, 2) is convex, not flat at any corner, and no sliver."""
    along = np.roll(corners, -1, axis=0) - corners
    onward = np.roll(along, -1, axis=0)
    cross = along[:, 0] * onward[:, 1] - along[:, 1] * onward[:, 0]
    lengths = np.linalg.norm(along, axis=1) * np.linalg.norm(onward, axis=1)
    if not np.all(cross > _SHARPEST_SINE * lengths):
        return False
    x, y = corners.T
    return bool(0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) > _SMALLEST_AREA * area_px)


def warp_points(points: Array, H: Array) -> Array:
    """Points (..., 2) px mapped by a homography; what it sends behind the camera or to infinity becomes NaN."""
    points = np.asarray(points, dtype=np.float64)
    mapped = points @ H[:, :2].T + H[:, 2]
    depth = mapped[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        warped: Array = np.where(depth > 0.0, mapped[..., :2] / depth, np.nan)
    return warped


def warp_picture(picture: Image, H: Array, size_px: tuple[int, int] | None = None, fill: int = 0) -> Image:
    """The warped picture.

    Args:
        picture: (H, W) or (H, W, 3) uint8.
        H: (3, 3), pixels of the picture to pixels of the warped one.
        size_px: (width, height) of the warped picture; that of the picture by default.
        fill: grey value where there is no picture.
    """
    size = size_px or (picture.shape[1], picture.shape[0])
    warped: Image = cv2.warpPerspective(
        picture, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(fill, fill, fill)
    )
    return warped


def valid_mask(
    H: Array, size_px: tuple[int, int], border: int = 3, warped_size_px: tuple[int, int] | None = None
) -> Mask:
    """Where the warped picture (H, W) shows the picture, at least ``border`` px from where the picture ends.

    The frame of the warped picture takes nothing away where the picture goes on beyond it. For the mask of the picture,
    where the warped one covers it, give the inverse of H.

    Args:
        H: (3, 3), pixels of the picture to pixels of the warped one.
        size_px: (width, height) of the picture.
        border: px, distance from where the picture ends; 0 for none.
        warped_size_px: (width, height) of the warped picture; that of the picture by default.
    """
    columns, rows = warped_size_px or size_px
    x, y = np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)[:, None]
    back = np.linalg.inv(H)
    back = back / np.abs(back).max()
    mask: Mask = back[2, 0] * x + back[2, 1] * y + back[2, 2] > 0.0
    # A side l of the picture, l (x, y, 1) = 0 and positive within, is the line H⁻ᵀ l of the warped one.
    sides = np.array([[1, 0, 0], [-1, 0, size_px[0] - 1], [0, 1, 0], [0, -1, size_px[1] - 1]], dtype=np.float64)
    for side in sides @ back:
        least = border * np.hypot(side[0], side[1]) - 1e-6 * np.abs(side).max()
        mask &= side[0] * x + side[1] * y + side[2] >= least
    return mask
