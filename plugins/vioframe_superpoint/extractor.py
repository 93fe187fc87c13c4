"""Keypoints of an image by SuperPoint."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vioframe.checks import Array, check_positive
from vioframe.errors import ConfigError
from vioframe.learning import SHIPPED
from vioframe.learning.holder import NetHolder
from vioframe.types import Image
from vioframe.vision.corners import place_corners
from vioframe.vision.keypoints import Keypoints
from vioframe.vision.spread import choose_spread
from vioframe_superpoint.options import Detection, Encoder, Refinement

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from vioframe_superpoint.net.inference import InferenceNet

_FOLDER = Path(__file__).parent / "weights"
_CELL_PX = 8
_DESCRIPTOR = 256
# Of the threshold, from the first value to the lowest.
_STEPS = 8


class SuperPointExtractor:
    """Points where the detector's heat has a maximum, with descriptors from the other head.

    Args:
        encoder: of the net.
        weights: ``shipped``, a file of trained weights, in MLflow too, or None for a random net.
        device: ``cpu``, ``cuda`` or ``auto``.
        half: work in half precision on a GPU.
        batch: most images at once on a GPU.
        keypoints: most an image.
        fewest: the threshold is lowered until there are so many.
        threshold: of the heat, at first.
        lowest_threshold: down to which it is lowered, in steps.
        suppression_px: no other point in the square of this half side around one.
        spread: choose strong points and empty parts of the image first; otherwise the strongest.
        refinement: ``heat`` moves a point to the centre of the heat around it, ``gradient`` to where the image's
            gradients meet, ``none`` leaves it at the maximum.
        refinement_px: half side of the window in which this is done.
        slot: for messages, what the user calls this part.

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
        keypoints: int = 300,
        fewest: int = 100,
        threshold: float = 0.015,
        lowest_threshold: float = 0.008,
        suppression_px: int = 4,
        spread: bool = True,
        refinement: Refinement = "heat",
        refinement_px: int = 2,
        slot: str = "frontend",
    ) -> None:
        check_positive(slot, batch=batch)
        self._options = Detection(
            keypoints=keypoints,
            fewest=fewest,
            threshold=threshold,
            lowest_threshold=lowest_threshold,
            suppression_px=suppression_px,
            spread=spread,
            refinement=refinement,
            refinement_px=refinement_px,
            slot=slot,
        )
        self._encoder = encoder
        self._half = half
        self._batch = batch
        self._slot = slot
        # A training begins without them; whoever wants to use them is told.
        shipped = _FOLDER / f"{encoder.name}.safetensors"
        self._lacks_shipped = weights == SHIPPED and not shipped.is_file()
        found = weights if weights != SHIPPED else None if self._lacks_shipped else str(shipped)
        self._holder = NetHolder(self, slot, "superpoint", self._make_net, found, device)
        self._inference: InferenceNet | None = None

    @property
    def net(self) -> "nn.Module":
        """Made when first asked for: torch is slow to import.

        Raises:
            ConfigError: there is no such file of weights.
            DataError: the file is of another architecture, or damaged.
        """
        return self._holder.net

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""
        return {"part": "superpoint", "encoder": self._encoder.name, "width": self._encoder.width}

    @property
    def needs_training(self) -> bool:
        """Without weights its points are those of a random net."""
        return self._holder.needs_training

    def device(self) -> "torch.device":
        """Where the net works.

        Raises:
            ConfigError: a GPU was asked for, and there is none.
        """
        return self._holder.device()

    def prepare(self) -> None:
        """Bring the net, as its weights are now, to its device.

        Raises:
            ConfigError: a GPU or a file of weights that is not there.
            DataError: the file of weights cannot be used.
        """
        from vioframe_superpoint.net.inference import InferenceNet
        from vioframe_superpoint.net.superpoint import SuperPointNet

        if self._lacks_shipped:
            raise ConfigError(
                f"{self._slot}.weights={SHIPPED}: no weights of encoder={self._encoder.name} came with this "
                f"installation; give {self._slot}.weights=FILE, or train some with task=train frontend=superpoint "
                f"encoder={self._encoder.name} ({self._slot}.weights=null runs a net of random weights)"
            )
        net = self._holder.prepare()
        if isinstance(net, SuperPointNet):
            self._inference = InferenceNet(net, half=self._half and self._holder.device().type == "cuda")

    def extract(self, gray: Image, allowed: np.ndarray) -> Keypoints:
        """Keypoints of an image (H, W) uint8 of any size where ``allowed`` (H, W) uint8 is not 0."""
        return self.extract_many([gray], allowed)[0]

    def extract_many(self, grays: Sequence[Image], allowed: np.ndarray) -> list[Keypoints]:
        """The same for several images of one size.

        On a GPU several pass through the net at once, which changes the last bits of half precision. On a CPU they
        pass one by one: together they would be slower (what a layer leaves no longer fits the cache), and not the
        same to the last bit where several threads share a mean.
        """
        import torch

        ready = self._ready
        device = self._holder.device()
        step = 1 if device.type == "cpu" else self._batch
        found: list[Keypoints] = []
        with torch.inference_mode():
            for first in range(0, len(grays), step):
                chosen = grays[first : first + step]
                heats, features = self._see(ready, chosen, allowed, device)
                for gray, heat, kept, map_ in zip(chosen, *heats, features, strict=True):
                    found.append(self._points(ready, gray, heat, kept, map_))
        return found

    def _see(
        self, ready: "InferenceNet", grays: Sequence[Image], allowed: np.ndarray, device: "torch.device"
    ) -> "tuple[tuple[Tensor, Tensor], Tensor]":
        """Heat (B, H, W), the same with its allowed maxima alone, and the maps that descriptors are made of."""
        import torch

        from vioframe_superpoint.net.keypoints import suppress

        height, width = grays[0].shape
        # Repeated pixels make no corner at the edge; what lies there is left out below.
        padded = [
            cv2.copyMakeBorder(gray, 0, -height % _CELL_PX, 0, -width % _CELL_PX, cv2.BORDER_REPLICATE)
            for gray in grays
        ]
        images = torch.from_numpy(np.stack(padded)).to(device)[:, None].float() / 255.0
        heat, features = ready.detect(images)
        heat = heat[:, :height, :width].contiguous()
        # What may not be taken must not keep its neighbours from being taken either.
        open_to = torch.where(torch.from_numpy(allowed != 0).to(device), heat, 0.0)
        return (heat, suppress(open_to, self._options.suppression_px)), features

    @property
    def _ready(self) -> "InferenceNet":
        if self._inference is None:
            self.prepare()
        if self._inference is None:
            raise ConfigError(f"{self._slot}=superpoint has a net of another kind")
        return self._inference

    def _points(
        self,
        ready: "InferenceNet",
        gray: Image,
        heat: "Tensor",
        kept: "Tensor",
        features: "Tensor",
    ) -> Keypoints:
        import torch

        rows, columns = torch.nonzero(kept >= self._options.lowest_threshold, as_tuple=True)
        scores = kept[rows, columns].cpu().numpy()
        places = torch.stack([columns, rows], dim=-1).cpu().numpy()
        chosen = self._choose(places, scores, gray.shape)
        if len(chosen) == 0:
            return Keypoints(
                pixels=np.zeros((0, 2)), scores=np.zeros(0), descriptors=np.zeros((0, _DESCRIPTOR), np.float32)
            )
        pixels = self._refine(gray, heat, places[chosen])
        where = torch.from_numpy(pixels.astype(np.float32)).to(features.device)
        descriptors: np.ndarray = ready.describe(features, where).cpu().numpy()
        return Keypoints(pixels=pixels, scores=scores[chosen].astype(float), descriptors=descriptors)

    def _choose(self, places: np.ndarray, scores: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Indices of the points (M, 2) that are kept."""
        options = self._options
        above = np.arange(0)
        for threshold in np.linspace(options.threshold, options.lowest_threshold, _STEPS):
            above = np.flatnonzero(scores >= threshold)
            if len(above) >= options.fewest:
                break
        if not options.spread:
            strongest: np.ndarray = above[np.argsort(-scores[above], kind="stable")[: options.keypoints]]
            return strongest
        even: np.ndarray = above[
            choose_spread(
                places[above],
                scores[above].astype(float),
                np.zeros((0, 2)),
                size_px=(shape[1], shape[0]),
                distance=options.suppression_px + 1.0,
                count=options.keypoints,
            )
        ]
        return even

    def _refine(self, gray: Image, heat: "Tensor", places: np.ndarray) -> Array:
        """Points (M, 2) px to a fraction of a pixel."""
        pixels = places.astype(float)
        half = self._options.refinement_px
        if self._options.refinement == "none":
            return pixels
        if self._options.refinement == "gradient":
            return place_corners(gray, pixels, half)
        import torch
        from torch.nn import functional

        reach = torch.arange(2 * half + 1, device=heat.device)
        columns, rows = torch.from_numpy(places).to(heat.device).unbind(dim=-1)
        around = functional.pad(heat, (half, half, half, half))
        window = (
            around[rows[:, None, None] + reach[:, None], columns[:, None, None] + reach].cpu().numpy().astype(float)
        )
        offset = np.arange(-half, half + 1.0)
        total = window.sum(axis=(1, 2))
        shift = np.stack([window.sum(axis=1) @ offset, window.sum(axis=2) @ offset], axis=-1) / total[:, None]
        refined: Array = pixels + shift
        return refined

    def _make_net(self) -> "nn.Module":
        from vioframe_superpoint.net.superpoint import make_net

        return make_net(self._encoder)
