"""How good the net is while it learns: pairs of views of pictures it does not learn from, and two drawings of them."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from vioframe.checks import Array
from vioframe.features.protocol import FeatureProtocol
from vioframe.features.scoring import PairScores, score_pair
from vioframe.pictures import HomographyOptions, LightingOptions, change_light, sample_homography, warp_picture
from vioframe.pictures.pairs import SPLITS, PicturePair
from vioframe.types import Image
from vioframe.vision.keypoints import Keypoints
from vioframe_superpoint.net.keypoints import heatmap, remove_border, sample_descriptors, suppress
from vioframe_superpoint.net.superpoint import SuperPointNet
from vioframe_superpoint.synthetic import SyntheticShapes
from vioframe_superpoint.training.adaptation import refined
from vioframe_superpoint.training.options import ShapesOptions
from vioframe_superpoint.training.steps import as_float

log = logging.getLogger(__name__)

_POINTS = 300
_RADIUS_PX = 4
_CORRECT_PX = 3.0
# Milder than what is learned from, as between the images of a camera that moves on: the ranges of the held-out set are
# never looked at.
_VIEWS = HomographyOptions(patch_ratio=0.8, perspective=0.2, scale=0.2, max_angle=0.5, overflow=0.0)
_VALIDATION = 5
# Mean cosine between descriptors of different points that leaves next to nothing to tell them apart by, and on how many
# pictures it is looked at.
_ALIKE = 0.9
_PICTURES = 4
_SHAPES_SEED = 7919
_SHAPES = 64


class NetExtractor:
    """Points and descriptors of a net that is being trained: the strongest, without a threshold.

    Args:
        net: on its device.
        points: at most.
    """

    def __init__(self, net: SuperPointNet, points: int = _POINTS) -> None:
        self._net = net
        self._points = points

    @torch.inference_mode()
    def extract(self, gray: Image, allowed: np.ndarray) -> Keypoints:
        """See :class:`vioframe.vision.keypoints.Extractor`; (H, W) are multiples of 8."""
        device = next(self._net.parameters()).device
        logits, maps = self._net(as_float(torch.from_numpy(np.array(gray)[None]).to(device)))
        heat = heatmap(logits.float())
        masked = heat * torch.from_numpy(allowed > 0).to(device)
        kept = suppress(remove_border(masked, _RADIUS_PX), _RADIUS_PX)[0].cpu().numpy()
        y, x = np.nonzero(kept > 0.0)
        order = np.argsort(-kept[y, x], kind="stable")[: self._points]
        pixels = refined(heat[0].cpu().numpy(), np.stack((x[order], y[order]), axis=1))
        descriptors = (
            sample_descriptors(maps, torch.from_numpy(pixels)[None].float().to(device))[0].float().cpu().numpy()
        )
        return Keypoints(pixels=pixels, scores=kept[y, x][order].astype(np.float64), descriptors=descriptors)


def validation_pairs(pictures: Sequence[Image], lighting: LightingOptions, seed: int) -> list[PicturePair]:
    """Two pairs of each picture: in other light, and from another view."""
    pairs = []
    for number, picture in enumerate(pictures):
        picture = np.array(picture)
        rng = np.random.default_rng([seed, _VALIDATION, number])
        H = sample_homography((picture.shape[1], picture.shape[0]), rng, _VIEWS)
        for split, view in zip(SPLITS, (np.eye(3), H), strict=True):
            first, second = picture, warp_picture(picture, view)
            if split == "illumination":
                first, second = (change_light(each, rng, lighting) for each in (first, second))
            pairs.append(
                PicturePair(first=first, second=second, H_second_first=view, name=f"{split} {number}", split=split)
            )
    return pairs


class PairValidation:
    """Scores of a net on pairs: 300 points, suppression within 4 px, correct within 3 px.

    Args:
        net: that is trained.
        pairs: all of one size.
    """

    def __init__(self, net: SuperPointNet, pairs: Sequence[PicturePair]) -> None:
        self._net = net
        self._pairs = list(pairs)
        height, width = pairs[0].first.shape
        self._protocol = FeatureProtocol(
            name="validation",
            width=width,
            height=height,
            points=_POINTS,
            suppression_px=_RADIUS_PX,
            border_px=_RADIUS_PX,
            correct_px=_CORRECT_PX,
            shared_only=True,
            max_distance=None,
            ransac_px=3.0,
            ransac_iterations=2000,
            ransac_confidence=0.999,
        )

    def figures(self) -> dict[str, float]:
        """Means over the pairs, by name; ``rank`` is that of repeatability and NN mAP over both splits.

        Warns where descriptors have become alike, which leaves homographies of easy pairs right for a long time.
        """
        extractor = NetExtractor(self._net)
        seen = [score_pair("superpoint", extractor, pair, self._protocol).scores for pair in self._pairs]
        figures: dict[str, float] = {}
        for split in SPLITS:
            figures |= {
                f"{split}/{name}": value for name, value in _means([s for s in seen if s.split == split]).items()
            }
        whole = _means(seen)
        alike = float(np.mean([self._alike(extractor, pair.first) for pair in self._pairs[: 2 * _PICTURES : 2]]))
        if alike > _ALIKE:
            log.warning(
                "descriptors of different points have a mean cosine of %.2f: they have become alike, as those do whose "
                "loss asks too much of them; raise negatives or radius_px of descriptor_loss=sparse_triplet, lower "
                "frontend.training.learning_rate, or choose descriptor_loss=sparse_hinge",
                alike,
            )
        return {
            "rank": 0.5 * (whole["repeatability"] + whole["mean_average_precision"]),
            "rep": whole["repeatability"],
            "hom": whole["homography_accuracy"],
            "match": whole["matching_score"],
            "alike": alike,
            **figures,
        }

    def _alike(self, extractor: NetExtractor, picture: Image) -> float:
        """Mean cosine between descriptors of different points of a picture."""
        found = extractor.extract(picture, np.full(picture.shape, 255, np.uint8)).descriptors
        count = max(len(found), 2)
        return float((np.sum(found, axis=0) ** 2).sum() - len(found)) / (count * (count - 1))

    def draw(self, path: Path) -> None:
        """A picture of points and matches: the first pair of either split."""
        from vioframe_superpoint.training.drawing import draw_pairs

        extractor = NetExtractor(self._net)
        shown = [next(pair for pair in self._pairs if pair.split == split) for split in SPLITS]
        draw_pairs(path, [(pair, score_pair("superpoint", extractor, pair, self._protocol)) for pair in shown])


def _means(scores: Sequence[PairScores]) -> dict[str, float]:
    described = [score.descriptors for score in scores if score.descriptors is not None]
    return {
        "repeatability": float(np.mean([score.repeatability for score in scores])),
        "matching_score": float(np.mean([each.matching_score for each in described])),
        "mean_average_precision": float(np.mean([each.average_precision for each in described])),
        "homography_accuracy": float(np.mean([each.corner_error_px <= _CORRECT_PX for each in described])),
    }


class ShapesValidation:
    """How well corners of drawn shapes are found, on shapes that are not learned from.

    Args:
        net: that is trained.
        options: of the first stage.
    """

    def __init__(self, net: SuperPointNet, options: ShapesOptions) -> None:
        self._net = net
        shapes = SyntheticShapes(size_px=(int(options.size_px[0]), int(options.size_px[1])), seed=_SHAPES_SEED)
        self._drawn = [shapes.picture(index) for index in range(_SHAPES)]

    def figures(self) -> Mapping[str, float]:
        """Precision and recall of heat above 0.1 within 3 px, and their harmonic mean, which is the ``rank``."""
        found = true = right = again = 0
        for picture, corners in self._drawn:
            points = self._points(picture)
            apart = np.linalg.norm(points[:, None] - corners[None], axis=2)
            found, true = found + len(points), true + len(corners)
            right += int((apart.min(axis=1, initial=np.inf) <= _CORRECT_PX).sum())
            again += int((apart.min(axis=0, initial=np.inf) <= _CORRECT_PX).sum())
        precision, recall = right / max(found, 1), again / max(true, 1)
        rank = 2.0 * precision * recall / max(precision + recall, 1e-9)
        return {"rank": rank, "precision": precision, "recall": recall}

    def draw(self, path: Path) -> None:
        """A picture of shapes with what was found on them."""
        from vioframe_superpoint.training.drawing import draw_points

        draw_points(path, [(picture, self._points(picture), corners) for picture, corners in self._drawn[:24]])

    @torch.inference_mode()
    def _points(self, picture: Image) -> Array:
        device = next(self._net.parameters()).device
        net = self._net
        logits = net.detector(net.encoder(as_float(torch.from_numpy(picture[None]).to(device))))
        kept = suppress(heatmap(logits.float()), _RADIUS_PX)[0].cpu().numpy()
        y, x = np.nonzero(kept > 0.1)
        return np.stack((x, y), axis=1).astype(np.float64)
