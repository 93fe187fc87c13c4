"""``frontend=superpoint``: learned keypoints matched by their descriptors, with lasting ids."""

from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.errors import ConfigError
from vioframe.learning import SHIPPED, require_torch
from vioframe.types import Frame, SensorRig, VisualFeatures
from vioframe.vision.descriptor_frontend import DescriptorFrontend
from vioframe.vision.keeper import KeeperOptions
from vioframe.vision.placing import AnchorOptions
from vioframe_superpoint.extractor import SuperPointExtractor
from vioframe_superpoint.options import Encoder, Refinement
from vioframe_superpoint.training import TrainingOptions

if TYPE_CHECKING:
    from torch import nn

    from vioframe.tracking import Tracker


class SuperPointFrontend(DescriptorFrontend):
    """Points and descriptors of SuperPoint (DeTone et al. 2018), matched near where the gyro puts them.

    Args:
        encoder: of the net.
        weights: ``shipped``, a file of trained weights, in MLflow too, or None for a random net.
        device: ``cpu``, ``cuda`` or ``auto``.
        half: work in half precision on a GPU.
        batch: most images at once on a GPU in :meth:`process_many`.
        stereo: also match with camera 1.
        min_depth: nearer points are not matched there, m.
        max_points: most points that have an id at once.
        min_distance_px: of a new point from all others.
        keypoints: most found an image, with or without an id.
        fewest: the threshold is lowered until there are so many.
        threshold: of the detector's heat, at first.
        lowest_threshold: down to which it is lowered.
        suppression_px: no other point in the square of this half side around one.
        refinement: of a point's place: ``heat``, ``gradient`` or ``none``.
        refinement_px: half side of the window in which this is done.
        anchor_window_px: odd side of the patch by which a matched point is placed; 0 leaves it where it was found.
        anchor_steps: to align the patch, an image.
        anchor_reach_px: largest distance of the aligned point from where it was found.
        min_correlation: of the patch that a point began with and what is seen now.
        follow_missed: look by its patch for a point that no keypoint matched.
        search_px: how far from where the gyro's rotation puts it a point is looked for.
        blind_search_px: the same where there is no gyro.
        memory_images: for how many images an absent point is remembered.
        max_distance: of two descriptors of one point, which are unit vectors.
        ratio: largest share of the second nearest descriptor's distance.
        reject_outliers: by the epipolar geometry of two images.
        outlier_px: distance from the epipolar line that contradicts it, in time and between the cameras.
        normalise_exposure: bring every image to one mean and contrast.
        border_px: no points nearer to the edge of the image.
        training: how ``task=train`` trains the net; None where it is not to be trained.

    Raises:
        ConfigError: an option outside its range, or torch is missing.
    """

    def __init__(
        self,
        *,
        encoder: Encoder,
        weights: str | None = SHIPPED,
        device: str = "auto",
        half: bool = True,
        batch: int = 8,
        stereo: bool = False,
        min_depth: float = 0.4,
        max_points: int = 200,
        min_distance_px: float = 14.0,
        keypoints: int = 300,
        fewest: int = 100,
        threshold: float = 0.015,
        lowest_threshold: float = 0.008,
        suppression_px: int = 4,
        refinement: Refinement = "heat",
        refinement_px: int = 2,
        anchor_window_px: int = 19,
        anchor_steps: int = 3,
        anchor_reach_px: float = 2.0,
        min_correlation: float = 0.8,
        follow_missed: bool = True,
        search_px: float = 15.0,
        blind_search_px: float = 80.0,
        memory_images: int = 5,
        max_distance: float = 0.7,
        ratio: float = 1.0,
        reject_outliers: bool = True,
        outlier_px: float = 2.0,
        normalise_exposure: bool = False,
        border_px: int = 8,
        training: TrainingOptions | None = None,
    ) -> None:
        _require("min_depth", min_depth, min_depth > 0.0, "positive")
        _require("keypoints", keypoints, keypoints >= max_points, f"at least max_points={max_points}")
        _require("max_distance", max_distance, 0.0 < max_distance <= 2.0, "above 0 and at most 2")
        _require("border_px", border_px, border_px >= 1, "at least 1")
        self._superpoint = SuperPointExtractor(
            encoder=encoder,
            weights=weights,
            device=device,
            half=half,
            batch=batch,
            keypoints=keypoints,
            fewest=fewest,
            threshold=threshold,
            lowest_threshold=lowest_threshold,
            suppression_px=suppression_px,
            refinement=refinement,
            refinement_px=refinement_px,
        )
        self._batch = batch
        self._encoder, self._device, self._training = encoder, device, training
        super().__init__(
            name="superpoint",
            extractor=self._superpoint,
            options=KeeperOptions(
                max_points=max_points,
                min_distance_px=min_distance_px,
                search_px=search_px,
                blind_search_px=blind_search_px,
                memory_images=memory_images,
                max_distance=max_distance,
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

    @property
    def net(self) -> "nn.Module":
        """See :class:`SuperPointExtractor`."""
        return self._superpoint.net

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""
        return self._superpoint.architecture

    @property
    def needs_training(self) -> bool:
        """Without weights its points are those of a random net."""
        return self._superpoint.needs_training

    def train_itself(self, folder: Path, tracker: "Tracker", *, shown: bool, resume: bool) -> Mapping[str, Path]:
        """See :class:`vioframe.interfaces.TrainsItself`. It begins with a random net, whatever ``weights`` says."""
        if self._training is None:
            raise ConfigError(
                "frontend.training is null, so there is nothing that says how to train frontend=superpoint"
            )
        require_torch("task=train frontend=superpoint", training=True)
        from vioframe_superpoint.training.stages import Training

        training = Training(
            self._encoder,
            self.architecture,
            self._training,
            device=self._superpoint.device(),
            folder=folder,
            tracker=tracker,
            shown=shown,
            resume=resume,
        )
        weights = training.run()
        return {} if weights is None else {"frontend": weights}

    def setup(self, rig: SensorRig) -> None:
        """Forget all points, and bring the net to its device.

        Raises:
            ConfigError: a GPU or a file of weights that is not there.
            DataError: the rig has too few cameras, or two at one place; the file of weights cannot be used.
        """
        super().setup(rig)
        self._superpoint.prepare()

    def process_many(self, frames: Iterable[Frame]) -> list[VisualFeatures]:
        """The same for images in a row, several at once in the net where :meth:`SuperPointExtractor.extract_many` is.

        Errors as of :meth:`process`.
        """
        rest = iter(frames)
        found: list[VisualFeatures] = []
        for part in iter(lambda: list(islice(rest, self._batch)), []):
            grays = [self.gray_images(frame) for frame in part]
            seen = [
                self._superpoint.extract_many([each[camera] for each in grays], mask)
                for camera, mask in enumerate(self.masks)
            ]
            found += [
                self.follow(frame, images, points, None)
                for frame, images, *points in zip(part, grays, *seen, strict=True)
            ]
        return found


def _require(option: str, value: object, good: bool, rule: str) -> None:
    if not good:
        raise ConfigError(f"frontend.{option} must be {rule}, got {value}")
