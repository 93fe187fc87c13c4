"""Flow between the images of a pair by dense inverse search, for an encoder that has not learned to find it."""

import cv2
import numpy as np
import torch
from torch import Tensor

# ITU-R BT.601, as OpenCV makes grey of red, green and blue.
_GRAY = (0.299, 0.587, 0.114)
# A car's flow at 10 Hz is shorter than this share of the image's width in 99 of 100 pixels: it is 1 to the net.
_UNIT = 0.09375


class PairFlow:
    """Dense inverse search (Kroeger et al. 2016) as OpenCV has it, at its medium quality; it learns nothing."""

    def __init__(self) -> None:
        self._solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def of_pairs(self, pairs: Tensor) -> Tensor:
        """Flow (N, 2, H, W), right and down in units of the net, of pairs (N, 6, H, W) of images in [0, 1]."""
        images = pairs.detach().reshape(-1, 2, 3, *pairs.shape[-2:])
        gray = (255.0 * images * images.new_tensor(_GRAY)[:, None, None]).sum(2)
        whole = gray.round().clamp(0.0, 255.0).to(torch.uint8).cpu().numpy()
        # Each pair on its own: what the solver finds must not depend on the pair before.
        found = np.stack([self._solver.calc(first, second, None) for first, second in whole])
        flow = torch.from_numpy(found).permute(0, 3, 1, 2).to(pairs.device)
        return (flow / (_UNIT * pairs.shape[-1])).contiguous()
