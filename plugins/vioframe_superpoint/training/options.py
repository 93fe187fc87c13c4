"""``frontend.training``: how the net is trained. Importing this module imports no torch."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Literal

from vioframe.checks import check_not_negative, check_positive
from vioframe.errors import ConfigError
from vioframe.pictures import HomographyOptions, LightingOptions

_KEY = "frontend.training"
_SCHEDULES = ("constant", "cosine", "trapezoid")
_PRECISIONS = ("auto", "32", "bf16")
_WITHOUT_BEARING = ("save_every", "max_minutes", "workers", "labels", "detector")


@dataclass(frozen=True, slots=True, kw_only=True)
class DescriptorLoss:
    """``descriptor_loss=``: what draws descriptors of one place together and of others apart.

    Attributes:
        weight: λ, of this loss beside the detector's two.
    """

    weight: float

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            check_not_negative("descriptor_loss", **{each.name: value})
        negatives = getattr(self, "negatives", 1)
        if negatives < 1:
            raise ConfigError(f"descriptor_loss.negatives must be 1 or more, got {negatives}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseLoss(DescriptorLoss):
    """Hinge over all pairs of cells (DeTone et al. 2018).

    Attributes:
        positive_margin, negative_margin: m_p, m_n of the scalar product.
        positive_weight: λ_d, of pairs that belong together, which are few.
        radius_px: within which a warped cell belongs to another.
    """

    positive_margin: float
    negative_margin: float
    positive_weight: float
    radius_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SparseHingeLoss(DescriptorLoss):
    """The same hinge on sampled pairs (Jau et al. 2020).

    Attributes:
        positive_margin, negative_margin, positive_weight: as of :class:`DenseLoss`.
        negatives: random non-matches of each match.
        radius_px: within which two points are no non-match.
    """

    positive_margin: float
    negative_margin: float
    positive_weight: float
    negatives: int
    radius_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SparseTripletLoss(DescriptorLoss):
    """Triplets with the nearest non-matches (Yu et al. 2021).

    Attributes:
        margin: m_d, of squared distances between unit vectors.
        negatives: M, nearest non-matches whose mean counts.
        radius_px: within which two points are no non-match.
        both_ways: also from the second image to the first.
    """

    margin: float
    negatives: int
    radius_px: float
    both_ways: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureOptions:
    """Pictures that are labelled and learned from.

    Attributes:
        count: how many.
        size_px: (width, height).
        folder: of images to take instead of generated ones, or None.
        places: share of rendered places among generated pictures; the others are textures.
        held_out: further ones, of which the pairs of validation are made.
    """

    count: int
    size_px: Sequence[int]
    folder: str | None
    places: float
    held_out: int

    def __post_init__(self) -> None:
        check_positive(f"{_KEY}.pictures", count=self.count, held_out=self.held_out)
        _check_size(f"{_KEY}.pictures.size_px", self.size_px)
        _check_share(f"{_KEY}.pictures.places", self.places)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapesOptions:
    """The first stage, MagicPoint: corners of drawn shapes.

    Attributes:
        iterations: of it.
        batch_size: pictures in a step.
        size_px: (width, height) of a picture.
        learning_rate: at its highest.
        corner_weight: of a cell with a corner beside one without; what comes out is as if it were 1.
    """

    iterations: int
    batch_size: int
    size_px: Sequence[int]
    learning_rate: float
    corner_weight: float

    def __post_init__(self) -> None:
        check_positive(
            f"{_KEY}.shapes",
            iterations=self.iterations,
            batch_size=self.batch_size,
            learning_rate=self.learning_rate,
            corner_weight=self.corner_weight,
        )
        _check_size(f"{_KEY}.shapes.size_px", self.size_px)


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptationOptions:
    """The second stage, homographic adaptation: labels for pictures.

    Attributes:
        homographies: answers that are averaged for a picture, the identity's included.
        threshold: of the mean.
        nms_radius_px: least distance of two labels.
        border_px: at the edge of a warped picture, where answers do not count.
        max_points: labels of a picture at most.
        least_views: share of the views that must show a pixel.
        batch_size: views that go through the net together.
        ranges: of the homographies.
    """

    homographies: int
    threshold: float
    nms_radius_px: int
    border_px: int
    max_points: int
    least_views: float
    batch_size: int
    ranges: HomographyOptions

    def __post_init__(self) -> None:
        key = f"{_KEY}.adaptation"
        check_positive(
            key,
            homographies=self.homographies,
            threshold=self.threshold,
            max_points=self.max_points,
            batch_size=self.batch_size,
        )
        check_not_negative(key, nms_radius_px=self.nms_radius_px, border_px=self.border_px)
        _check_share(f"{key}.least_views", self.least_views)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOptions:
    """How two views of a picture are made for the third stage.

    Attributes:
        size_px: (width, height) of a view, multiples of 8.
        scale: [least, most] px of a view for one of the picture.
        homographies: ranges of the one between the views.
        lighting: changes of light, of each view by itself.
        matches: points of a pair, at most, on which sparse losses stand.
        labelled: share of them that are labels, the others lie anywhere.
    """

    size_px: Sequence[int]
    scale: Sequence[float]
    homographies: HomographyOptions
    lighting: LightingOptions
    matches: int
    labelled: float

    def __post_init__(self) -> None:
        key = f"{_KEY}.pairs"
        _check_size(f"{key}.size_px", self.size_px)
        if len(self.scale) != 2 or not 0.0 < self.scale[0] <= self.scale[1]:
            raise ConfigError(f"{key}.scale must be [least, most], both positive, got {list(self.scale)}")
        check_positive(key, matches=self.matches)
        _check_share(f"{key}.labelled", self.labelled)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingOptions:
    """The options, checked.

    Attributes:
        seed: of weights, pictures, labels and pairs.
        iterations: of the third stage, in which detector and descriptors are trained together.
        batch_size: pairs in a step.
        learning_rate: at its highest.
        schedule: ``constant``, ``cosine`` to zero, or ``trapezoid``: constant, then linear to zero over the last fifth.
        warmup: iterations over which the rate rises.
        weight_decay: of AdamW; 0 is Adam.
        gradient_clip: largest norm of the gradient; 0 for no limit.
        save_every: iterations between points to resume at.
        validate_every: iterations between validations, a multiple of ``save_every``.
        max_minutes: of this call; None for no limit.
        precision: ``32``, ``bf16`` or ``auto``: bf16 where the machine has it in hardware.
        workers: processes that make pictures and pairs beside the training.
        labels: folder of labelled pictures, shared by trainings; made where there is none. None: in the run's folder.
        detector: weights of this encoder that label the pictures, instead of a first stage; None trains one.
        descriptor_loss: the loss of the descriptors.
        pictures, shapes, adaptation, pairs: of the stages.

    Raises:
        ConfigError: with the key and its value.
    """

    seed: int
    iterations: int
    batch_size: int
    learning_rate: float
    schedule: Literal["constant", "cosine", "trapezoid"]
    warmup: int
    weight_decay: float
    gradient_clip: float
    save_every: int
    validate_every: int
    max_minutes: float | None
    precision: Literal["auto", "32", "bf16"]
    workers: int
    labels: str | None
    detector: str | None
    descriptor_loss: DescriptorLoss
    pictures: PictureOptions
    shapes: ShapesOptions
    adaptation: AdaptationOptions
    pairs: PairOptions

    def __post_init__(self) -> None:
        check_positive(
            _KEY,
            iterations=self.iterations,
            batch_size=self.batch_size,
            learning_rate=self.learning_rate,
            save_every=self.save_every,
            validate_every=self.validate_every,
        )
        check_not_negative(
            _KEY,
            seed=self.seed,
            warmup=self.warmup,
            weight_decay=self.weight_decay,
            gradient_clip=self.gradient_clip,
            workers=self.workers,
        )
        if self.validate_every % self.save_every:
            raise ConfigError(
                f"{_KEY}.validate_every={self.validate_every} must be a multiple of {_KEY}.save_every={self.save_every}"
            )
        if self.schedule not in _SCHEDULES:
            raise ConfigError(f"{_KEY}.schedule must be one of {', '.join(_SCHEDULES)}, got {self.schedule!r}")
        if str(self.precision) not in _PRECISIONS:
            raise ConfigError(f"{_KEY}.precision must be one of {', '.join(_PRECISIONS)}, got {self.precision!r}")
        if self.max_minutes is not None:
            check_positive(_KEY, max_minutes=self.max_minutes)

    def settings(self) -> dict[str, object]:
        """All that has a bearing on the weights, as plain values."""
        plain = plain_values(self)
        return {name: value for name, value in plain.items() if name not in _WITHOUT_BEARING}


def plain_values(options: object) -> dict[str, object]:
    """Options, and those in them, as plain values for a card or a hash."""
    values: dict[str, object] = {}
    for each in fields(options):  # type: ignore[arg-type]
        value = getattr(options, each.name)
        if is_dataclass(value):
            value = {"kind": type(value).__name__, **plain_values(value)}
        elif isinstance(value, Sequence) and not isinstance(value, str):
            value = list(value)
        values[each.name] = value
    return values


def _check_size(key: str, size_px: Sequence[int]) -> None:
    if len(size_px) != 2 or any(side < 32 or side % 8 for side in size_px):
        raise ConfigError(f"{key} must be [width, height] px, multiples of 8 from 32 on, got {list(size_px)}")


def _check_share(key: str, share: float) -> None:
    if not 0.0 <= share <= 1.0:
        raise ConfigError(f"{key} must be from 0 to 1, got {share}")
