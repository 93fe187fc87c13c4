"""What flow front ends have in common: size, levels, cache, and one path for single images and many."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice, pairwise
from typing import ClassVar

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.interfaces import FLOW, Frontend
from vioframe.types import Camera, Frame, Image, SensorRig, VisualFeatures
from vioframe.vision.flow_levels import flow_to_levels, levels_to_flow
from vioframe.vision.gray import gray_image
from vioframe_flow.cache import FlowCache

SMALLEST_PX = 16
"""Side of the smallest image that has flow worth the name."""


class FlowFrontend(Frontend):
    """Dense flow from each image of camera 0 to the next, on the grid of the former.

    ``VisualFeatures.flow`` of an image is (H, W, 2) float32 px, x then y, from the image before; zero at the first.

    Args:
        name: the option of the group ``frontend``, for messages.
        size_px: (width, height) to which images are brought first, and the size of the flow, whose pixels are those
            of that size; None keeps the image.
        quantise: round flow to 256 levels.
        bound: flow at the last of them, as a share of the image's width.
        cache: folder, or None.
        batch: most pairs solved at once by :meth:`process_many`.

    Raises:
        ConfigError: an option outside its range.
    """

    provides: ClassVar[frozenset[str]] = frozenset({FLOW})

    def __init__(
        self,
        *,
        name: str,
        size_px: Sequence[int] | None,
        quantise: bool,
        bound: float,
        cache: str | None,
        batch: int,
    ) -> None:
        size = None if size_px is None else tuple(size_px)
        if size is not None:
            whole = len(size) == 2 and all(isinstance(side, int) and side >= SMALLEST_PX for side in size)
            require("size_px", size_px, whole, f"[width, height], whole numbers of at least {SMALLEST_PX}, or null")
        require("bound", bound, bound > 0.0, "positive")
        require("batch", batch, batch >= 1, "at least 1")
        self._name = name
        self._size = None if size is None else (size[0], size[1])
        self._quantise = quantise
        self._bound = bound
        self._cache_folder = cache
        self._batch = batch
        self._cache: FlowCache | None = None
        self._camera: Camera | None = None
        self._before: Image | None = None

    def setup(self, rig: SensorRig) -> None:
        """Forget the last image.

        Raises:
            DataError: the rig has no camera, or one of a handful of pixels, or the cache's folder cannot be made.
        """
        if not rig.cameras:
            raise DataError(f"frontend={self._name} needs a camera, but the recording's calibration has none")
        width, height = rig.cameras[0].size_px
        if min(width, height) < SMALLEST_PX:
            raise DataError(
                f"frontend={self._name} needs images of at least {SMALLEST_PX}×{SMALLEST_PX} px, but the recording's "
                f"are {width}×{height} px"
            )
        self._camera = rig.cameras[0]
        self._before = None
        self._cache = self._open_cache()

    def counters(self) -> Mapping[str, int]:
        """What the cache had and what it lacked."""
        if self._cache is None:
            return {}
        counted = {"flows from cache": self._cache.hits, "flows computed": self._cache.misses}
        return counted | ({"damaged flows": self._cache.damaged} if self._cache.damaged else {})

    def process(self, frame: Frame, R_prev_cur: Array | None = None) -> VisualFeatures:
        """Flow from the image before to this one.

        Raises:
            StateError: called before ``setup``.
            DataError: the frame has no image, or one that does not fit the calibration; the cache has no space.
        """
        return self.process_many([frame])[0]

    def process_many(self, frames: Iterable[Frame]) -> list[VisualFeatures]:
        """The same for images in a row, several pairs at once; errors as of :meth:`process`."""
        rest = iter(frames)
        return [made for part in iter(lambda: list(islice(rest, self._batch)), []) for made in self._process(part)]

    def _process(self, frames: Sequence[Frame]) -> Iterator[VisualFeatures]:
        if self._camera is None:
            raise StateError(f"{type(self).__name__}.process was called before setup(rig): set it up first")
        images = [self._prepare(frame, self._camera) for frame in frames]
        begin = [] if self._before is None else [self._before]
        chain = begin + images
        self._before = images[-1]
        flows = self._flows(chain)
        if not begin:
            flows.insert(0, np.zeros((*images[0].shape, 2), np.float32))
        for frame, flow in zip(frames, flows, strict=True):
            yield VisualFeatures(frame=frame, flow=flow)

    def flow_batch(self, images: np.ndarray) -> np.ndarray:
        """Flow (B, S, H, W, 2) float32 px of the pairs in windows of consecutive images, from the cache if it is there.

        Args:
            images: (B, S + 1, H, W) or (B, S + 1, H, W, 3) RGB, uint8.

        Raises:
            DataError: the cache has no space.
        """
        self._cache = self._open_cache()
        return np.stack([self._flows([to_gray(self._resize(image)) for image in window]) for window in images])

    def _open_cache(self) -> FlowCache | None:
        """The cache for what :meth:`settings` says now; None where there is none."""
        if self._cache_folder is None:
            return None
        kept = f"levels of {self._bound!r} of the width" if self._quantise else "pixels"
        return FlowCache(self._cache_folder, f"{self.settings()} {kept}")

    def _prepare(self, frame: Frame, camera: Camera) -> Image:
        gray_image(frame, 0, camera, self._name)  # refuses what does not fit the calibration
        # Made grey after it is resized, as a training does, which keeps resized colour.
        return to_gray(self._resize(frame.images[0]))

    def _resize(self, image: Image) -> Image:
        if self._size is None or image.shape[1::-1] == self._size:
            return image
        # Averages areas where the image shrinks, which leaves nothing to alias.
        resized: Image = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        return resized

    def _flows(self, chain: Sequence[Image]) -> list[Array]:
        """Flow px between each image of the chain and the next."""
        count = len(chain) - 1
        bound_px = self._bound * chain[0].shape[1]
        kept: list[np.ndarray | None] = [None] * count
        keys: list[str] = []
        if self._cache is not None and count:
            digests = [self._cache.digest(image) for image in chain]
            keys = [self._cache.key(*pair) for pair in pairwise(digests)]
            dtype = np.uint8 if self._quantise else np.float32
            kept = [self._cache.load(key, (*chain[0].shape, 2), dtype) for key in keys]
        missing = [index for index in range(count) if kept[index] is None]
        if missing:
            first = np.stack([chain[index] for index in missing])
            second = np.stack([chain[index + 1] for index in missing])
            for index, flow in zip(missing, self.solve(first, second), strict=True):
                made = flow_to_levels(flow, bound_px) if self._quantise else flow
                kept[index] = made
                if self._cache is not None:
                    self._cache.store(keys[index], made)
        found = [flow for flow in kept if flow is not None]
        return [levels_to_flow(flow, bound_px) for flow in found] if self._quantise else found

    @abstractmethod
    def solve(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Flow (B, H, W, 2) float32 px of pairs of grey images (B, H, W) uint8, one by one or all at once."""

    @abstractmethod
    def settings(self) -> str:
        """All that :meth:`solve` depends on beside the images, as text."""


def to_gray(image: Image) -> Image:
    """(H, W) of (H, W) or (H, W, 3) RGB."""
    gray: Image = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return gray


def require(option: str, value: object, good: bool, rule: str) -> None:
    """Refuse an option of the front end that breaks its rule.

    Raises:
        ConfigError: with the key and its value.
    """
    if not good:
        raise ConfigError(f"frontend.{option} must be {rule}, got {value}")
