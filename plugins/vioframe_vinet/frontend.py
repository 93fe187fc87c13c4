"""``frontend=pair_encoder``: each image with the one before it, as one vector."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from vioframe.checks import Array, check_positive
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.interfaces import EMBEDDING, IMAGES, Frontend
from vioframe.learning.holder import NetHolder
from vioframe.learning.images import NetImages
from vioframe.types import Frame, SensorRig, VisualFeatures

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch
    from vioframe_vinet.net.memo import Memo
    from vioframe_vinet.net.pair_flow import PairFlow

# Pairs that a frozen encoder is given at once.
_AT_ONCE = 64

Flow = Literal["dis", "none"]


class PairEncoder(Frontend):
    """FlowNetS convolutions on two images in a row, as the spatial stream of TSVO; trained through the fuser.

    The embedding of an image without one before it is zero: a fuser knows from its window whether both are there.

    Args:
        size_px: (width, height) to which images are brought.
        gray: take images in grey, even where the camera has colour.
        features: numbers of the embedding, each between −1 and 1.
        width: factor on the channels of the convolutions.
        batch_norm: after each convolution.
        flow: ``dis`` shows the convolutions the flow between the images too, found by dense inverse search; ``none``.
        batch: most pairs at once in :meth:`process_many`.
        weights: file of trained weights, in MLflow too, or None.
        device: ``cpu``, ``cuda`` or ``auto``.

    Raises:
        ConfigError: an option outside its range, or torch is missing.
    """

    requires: ClassVar[frozenset[str]] = frozenset({IMAGES})
    provides: ClassVar[frozenset[str]] = frozenset({EMBEDDING})

    def __init__(
        self,
        *,
        size_px: Sequence[int] = (512, 256),
        gray: bool = False,
        features: int = 256,
        width: float = 1.0,
        batch_norm: bool = True,
        flow: Flow = "dis",
        batch: int = 8,
        weights: str | None = None,
        device: str = "auto",
    ) -> None:
        check_positive("frontend", features=features, width=width, batch=batch)
        self._images = NetImages(slot="frontend", name="pair_encoder", size_px=size_px, gray=gray)
        self._size = (size_px[0], size_px[1])
        self._gray = gray
        self._features = features
        self._width = width
        self._batch_norm = batch_norm
        if flow not in ("dis", "none"):
            raise ConfigError(f"frontend.flow must be one of dis, none, got {flow!r}")
        self._with_flow = flow == "dis"
        self._batch = batch
        self._holder = NetHolder(self, "frontend", "pair_encoder", self._make_net, weights, device)
        self._before: Tensor | None = None
        self._flow: PairFlow | None = None
        self._memo: Memo | None = None
        self._ready = False

    @property
    def net(self) -> "nn.Module":
        """``encoder``; made when first asked for: torch is slow to import.

        Raises:
            ConfigError: there is no such file of weights.
            DataError: the file is of another architecture, or damaged.
        """
        return self._holder.net

    @property
    def context_pairs(self) -> int:
        """Each pair is encoded for itself."""
        return 1

    @property
    def needs_training(self) -> bool:
        """Without weights its embeddings are those of a random net."""
        return self._holder.needs_training

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with."""
        return {
            "part": "pair_encoder",
            "width_px": self._size[0],
            "height_px": self._size[1],
            "gray": self._gray,
            "features": self._features,
            "width": self._width,
            "batch_norm": self._batch_norm,
            "flow": self._with_flow,
        }

    def setup(self, rig: SensorRig) -> None:
        """Forget the last image and bring the net to its device.

        Raises:
            ConfigError: a GPU or a file of weights that is not there.
            DataError: the rig has no camera; the file of weights cannot be used.
        """
        if not rig.cameras:
            raise DataError("frontend=pair_encoder needs a camera, but the recording's calibration has none")
        self._holder.prepare()
        self._before = None
        self._ready = True

    def process(self, frame: Frame, R_prev_cur: Array | None = None) -> VisualFeatures:
        """Encode the image before and this one.

        Args:
            frame: on the IMU clock; one without an image gets no embedding, and neither does it serve the next.
            R_prev_cur: not used.

        Raises:
            StateError: called before ``setup``.
        """
        return self.process_many([frame])[0]

    def process_many(self, frames: Iterable[Frame]) -> list[VisualFeatures]:
        """The same for images in a row, several pairs at once; errors as of :meth:`process`."""
        rest = iter(frames)
        return [made for part in iter(lambda: list(islice(rest, self._batch)), []) for made in self._encode(part)]

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """``embedding`` (B, S, D) of the pairs of each window.

        Args:
            batch: with images in [0, 1] of ``size_px``.
            upstream: not used.

        Raises:
            ConfigError: images of another size than the net's.
        """
        self._holder.taught()
        frozen = not self.net.training and not any(each.requires_grad for each in self.net.parameters())
        if frozen and batch.images.device.type == "cpu":
            return {EMBEDDING: self._remembered(batch.images)}
        pairs = self._images.pairs_of_batch(batch.images)
        embedding = self._embeddings(pairs.flatten(0, 1))
        return {EMBEDDING: embedding.reshape(*pairs.shape[:2], self._features)}

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """None of its own: what an embedding should say only the parts after it know."""
        return {}

    def _encode(self, frames: Sequence[Frame]) -> list[VisualFeatures]:
        import torch

        if not self._ready:
            raise StateError("PairEncoder.process was called before setup(rig): set it up first")
        pairs: list[Tensor] = []
        numbers: list[int] = []
        for number, frame in enumerate(frames):
            image = self._images.of_frame(frame, self._holder.device()) if frame.images else None
            if image is not None and self._before is not None:
                pairs.append(torch.cat([self._before, image]))
                numbers.append(number)
            self._before = image
        found = np.zeros((len(frames), self._features))
        if pairs:
            with torch.inference_mode():
                found[numbers] = self._embeddings(torch.stack(pairs)).cpu().numpy()
        return [
            VisualFeatures(frame=frame, embedding=embedding if frame.images else None)
            for frame, embedding in zip(frames, found, strict=True)
        ]

    def _remembered(self, images: "Tensor") -> "Tensor":
        """(B, S, D) of windows, each pair encoded when it is first seen."""
        import torch

        from vioframe_vinet.net.memo import Memo

        self._memo = self._memo or Memo()

        def encode(places: "Tensor") -> "Tensor":
            made = []
            for first in range(0, len(places), _AT_ONCE):
                window, pair = places[first : first + _AT_ONCE].unbind(1)
                two = torch.stack([images[window, pair], images[window, pair + 1]], dim=1)
                made.append(self._embeddings(self._images.pairs_of_batch(two).flatten(0, 1)))
            return torch.cat(made)

        with torch.no_grad():
            return self._memo.embeddings(self.net, images, encode)

    def _embeddings(self, pairs: "Tensor") -> "Tensor":
        """(N, D) of pairs (N, 6, H, W) in [0, 1]."""
        from vioframe_vinet.net.pair_flow import PairFlow

        if self._with_flow and self._flow is None:
            self._flow = PairFlow()
        flow = None if self._flow is None else self._flow.of_pairs(pairs)
        embeddings: Tensor = self.net.get_submodule("encoder")(pairs, flow)
        return embeddings

    def _make_net(self) -> "nn.Module":
        from torch import nn

        from vioframe_vinet.net.encoder import PairEncoderNet

        encoder = PairEncoderNet(
            size_px=self._size,
            features=self._features,
            width=self._width,
            batch_norm=self._batch_norm,
            with_flow=self._with_flow,
        )
        return nn.ModuleDict({"encoder": encoder})
