"""Images as nets take them: one size, grey or RGB, in [0, 1], the same from a stream as from a batch.

Importing this costs nothing; torch is imported with the first image.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vioframe.errors import ConfigError, DataError
from vioframe.types import Frame, Image

if TYPE_CHECKING:
    import torch
    from torch import Tensor

# What OpenCV weighs red, green and blue with (ITU-R BT.601).
_GRAY = (0.299, 0.587, 0.114)


class NetImages:
    """Brings images of camera 0 to what one net takes.

    Args:
        slot: of the part, such as ``vo``, for messages.
        name: its option there, such as ``tsvo``.
        size_px: (width, height) to which images are brought.
        gray: take images in grey, even where the camera has colour.

    Raises:
        ConfigError: a size that is none.
    """

    def __init__(self, *, slot: str, name: str, size_px: Sequence[int], gray: bool) -> None:
        check_size(f"{slot}.size_px", size_px)
        self._slot = slot
        self._name = name
        self._size = (size_px[0], size_px[1])
        self._gray = gray

    def of_frame(self, frame: Frame, device: "torch.device") -> "Tensor":
        """(3, H, W) in [0, 1]; grey images three times.

        Raises:
            DataError: a frame without an image.
        """
        import torch

        if not frame.images:
            raise DataError(f"frame at {frame.stamp_ns} ns has no image, and {self._slot}={self._name} needs one")
        image: Image = frame.images[0]
        if self._gray and image.ndim == 3:
            image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if image.shape[1::-1] != self._size:
            # As training images are resized: averages over areas, which leaves nothing to alias.
            image = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        channels = image[None].repeat(3, axis=0) if image.ndim == 2 else image.transpose(2, 0, 1)
        return torch.from_numpy(np.ascontiguousarray(channels)).to(device).float() / 255.0

    def pairs_of_batch(self, images: "Tensor") -> "Tensor":
        """Neighbours (B, S, 6, H, W) of images in a row (B, S + 1, C, H, W), the earlier first.

        Raises:
            ConfigError: images of another size than the net's.
        """
        from vioframe.learning.flownet import pairs_of

        self.check_training_size("trainer.size_px", images)
        if self._gray and images.shape[2] == 3:
            images = (images * images.new_tensor(_GRAY)[:, None, None]).sum(2, keepdim=True)
        return pairs_of(images)

    def check_training_size(self, key: str, maps: "Tensor") -> None:
        """Refuse maps (..., H, W) of another size than the net's, which streaming would have resized.

        Raises:
            ConfigError: with the option ``key`` that made them so.
        """
        if tuple(maps.shape[:-3:-1]) != self._size:
            (width, height), (made_width, made_height) = self._size, maps.shape[:-3:-1]
            raise ConfigError(
                f"{key} makes training see {made_width}×{made_height} px, but {self._slot}.size_px is "
                f"{width}×{height}: set them alike"
            )


def check_size(key: str, size_px: Sequence[int]) -> None:
    """Refuse what is no (width, height).

    Raises:
        ConfigError: with the key and its value.
    """
    if len(size_px) != 2 or not all(isinstance(side, int) and side >= 16 for side in size_px):
        raise ConfigError(f"{key} must be [width, height], whole numbers of at least 16, got {list(size_px)}")
