"""``frontend=orb``: keypoints matched by binary descriptors, with lasting ids."""

from vioframe.errors import ConfigError
from vioframe.vision.descriptor_frontend import DescriptorFrontend
from vioframe.vision.keeper import KeeperOptions
from vioframe.vision.placing import AnchorOptions
from vioframe_orb.extractor import OrbExtractor


class OrbFrontend(DescriptorFrontend):
    """Corners described by ORB (Rublee et al. 2011), matched near where the gyro puts them.

    Args:
        stereo: also match with camera 1.
        min_depth: nearer points are not matched there, m.
        max_points: most points that have an id at once.
        min_distance_px: of a new point from all others.
        keypoints: most found an image, with or without an id.
        spacing_px: least distance between two of them.
        quality: fraction of the strongest corner's smaller eigenvalue a corner needs.
        min_gradient: square root of that eigenvalue a corner needs at least, grey levels a pixel.
        subpixel_px: half side of the window in which a corner is placed, or 0.
        upright: describe patches as they lie in the image, not turned to their brightest side.
        anchor_window_px: odd side of the patch by which a matched point is placed; 0 leaves it where it was found.
        anchor_steps: to align the patch, an image.
        anchor_reach_px: largest distance of the aligned point from where it was found.
        min_correlation: of the patch that a point began with and what is seen now.
        follow_missed: look by its patch for a point that no keypoint matched.
        search_px: how far from where the gyro's rotation puts it a point is looked for.
        blind_search_px: the same where there is no gyro.
        memory_images: for how many images an absent point is remembered.
        max_distance_bits: of two descriptors of one point, of 256.
        ratio: largest share of the second nearest descriptor's distance.
        reject_outliers: by the epipolar geometry of two images.
        outlier_px: distance from the epipolar line that contradicts it, in time and between the cameras.
        normalise_exposure: bring every image to one mean and contrast.
        border_px: no points nearer to the edge of the image.

    Raises:
        ConfigError: an option outside its range.
    """

    def __init__(
        self,
        *,
        stereo: bool = False,
        min_depth: float = 0.4,
        max_points: int = 200,
        min_distance_px: float = 14.0,
        keypoints: int = 400,
        spacing_px: float = 10.0,
        quality: float = 0.003,
        min_gradient: float = 1.0,
        subpixel_px: int = 4,
        upright: bool = True,
        anchor_window_px: int = 19,
        anchor_steps: int = 3,
        anchor_reach_px: float = 2.0,
        min_correlation: float = 0.8,
        follow_missed: bool = True,
        search_px: float = 15.0,
        blind_search_px: float = 80.0,
        memory_images: int = 5,
        max_distance_bits: int = 60,
        ratio: float = 0.8,
        reject_outliers: bool = True,
        outlier_px: float = 2.0,
        normalise_exposure: bool = True,
        border_px: int = 16,
    ) -> None:
        _require("min_depth", min_depth, min_depth > 0.0, "positive")
        _require("keypoints", keypoints, keypoints >= max_points, f"at least max_points={max_points}")
        _require("spacing_px", spacing_px, spacing_px >= 2.0, "at least 2")
        _require("quality", quality, 0.0 < quality < 1.0, "between 0 and 1")
        _require("min_gradient", min_gradient, min_gradient >= 0.0, "not negative")
        _require("subpixel_px", subpixel_px, 0 <= subpixel_px <= 20, "from 0 to 20")
        _require("max_distance_bits", max_distance_bits, 1 <= max_distance_bits <= 256, "from 1 to 256")
        _require("border_px", border_px, border_px >= 1, "at least 1")
        super().__init__(
            name="orb",
            extractor=OrbExtractor(
                count=keypoints,
                spacing_px=spacing_px,
                quality=quality,
                min_gradient=min_gradient,
                subpixel_px=subpixel_px,
                upright=upright,
            ),
            options=KeeperOptions(
                max_points=max_points,
                min_distance_px=min_distance_px,
                search_px=search_px,
                blind_search_px=blind_search_px,
                memory_images=memory_images,
                max_distance=float(max_distance_bits),
                ratio=ratio,
                reject_outliers=reject_outliers,
                outlier_px=outlier_px,
            ),
            stereo=stereo,
            min_depth=min_depth,
            normalise=normalise_exposure,
            border_px=border_px,
            anchors=AnchorOptions(
                window_px=anchor_window_px,
                steps=anchor_steps,
                reach_px=anchor_reach_px,
                min_correlation=min_correlation,
                memory_images=memory_images,
                follow=follow_missed,
            ),
        )


def _require(option: str, value: object, good: bool, rule: str) -> None:
    if not good:
        raise ConfigError(f"frontend.{option} must be {rule}, got {value}")
