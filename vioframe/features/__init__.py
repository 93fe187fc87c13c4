"""Keypoints judged on pairs of pictures with a known homography; docs/features.md tells how each number is defined."""

from vioframe.features.evaluation import ALL, Summary, evaluate_pairs, summarise
from vioframe.features.homography import corner_error_px, estimate_homography, homography_accuracy
from vioframe.features.matches import average_precision, matching_score
from vioframe.features.points import distances_px, repetition
from vioframe.features.protocol import EPSILONS_PX, FeatureProtocol
from vioframe.features.scoring import DescriptorScores, PairScores, Seen, score_pair

__all__ = [
    "ALL",
    "EPSILONS_PX",
    "DescriptorScores",
    "FeatureProtocol",
    "PairScores",
    "Seen",
    "Summary",
    "average_precision",
    "corner_error_px",
    "distances_px",
    "estimate_homography",
    "evaluate_pairs",
    "homography_accuracy",
    "matching_score",
    "repetition",
    "score_pair",
    "summarise",
]
