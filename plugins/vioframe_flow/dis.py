"""``frontend=dis``: dense inverse search, as in OpenCV."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vioframe.errors import DataError
from vioframe.interfaces import FLOW
from vioframe.learning import require_torch
from vioframe.types import SensorRig
from vioframe_flow.frontend import FlowFrontend, require

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vioframe.learning.batch import WindowBatch

_PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}


class DisFrontend(FlowFrontend):
    """Dense inverse search (Kroeger et al. 2016), then variational refinement.

    It has nothing to learn, but takes part in training: its net is empty, and what comes after it learns from its
    flow.

    Args:
        size_px: (width, height) to which images are brought first, and the size of the flow; None keeps the image.
        preset: ``ultrafast``, ``fast`` or ``medium``.
        finest_scale: where the pyramid ends: 0 is the full image, each further one half of it; None as the preset.
        descent_steps: Gauss–Newton steps a patch; None as the preset.
        refinement_steps: of the variational refinement, 0 leaves it out; None as the preset.
        quantise: round flow to 256 levels.
        bound: flow at the last of them, as a share of the image's width.
        cache: folder in which flows are kept, or None.

    Raises:
        ConfigError: an option outside its range.
    """

    context_pairs = 1
    needs_training = False

    def __init__(
        self,
        *,
        size_px: Sequence[int] | None = None,
        preset: str = "medium",
        finest_scale: int | None = None,
        descent_steps: int | None = None,
        refinement_steps: int | None = None,
        quantise: bool = True,
        bound: float = 0.09375,
        cache: str | None = None,
    ) -> None:
        super().__init__(name="dis", size_px=size_px, quantise=quantise, bound=bound, cache=cache, batch=1)
        require("preset", preset, preset in _PRESETS, f"one of {', '.join(_PRESETS)}")
        self._preset = preset
        self._solver = cv2.DISOpticalFlow.create(_PRESETS[preset])
        if finest_scale is not None:
            require("finest_scale", finest_scale, 0 <= finest_scale <= 4, "from 0 to 4, or null")
            self._solver.setFinestScale(finest_scale)
        if descent_steps is not None:
            require("descent_steps", descent_steps, descent_steps >= 1, "at least 1, or null")
            self._solver.setGradientDescentIterations(descent_steps)
        if refinement_steps is not None:
            require("refinement_steps", refinement_steps, refinement_steps >= 0, "not negative, or null")
            self._solver.setVariationalRefinementIterations(refinement_steps)

    def setup(self, rig: SensorRig) -> None:
        """Forget the last image.

        Raises:
            DataError: the rig has no camera, or the coarsest scale has no room for a patch; the cache's folder
                cannot be made.
        """
        super().setup(rig)
        size = self._size or rig.cameras[0].size_px
        # Below this OpenCV 5.0 ends the process without a word.
        least = self._solver.getPatchSize() * 2 ** self._solver.getFinestScale()
        if min(size) < least:
            raise DataError(
                f"frontend=dis with finest_scale={self._solver.getFinestScale()} needs images of at least "
                f"{least}×{least} px, but they are {size[0]}×{size[1]} px: make frontend.finest_scale smaller or "
                "frontend.size_px larger"
            )

    def solve(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Flow (B, H, W, 2) float32 px of pairs of grey images (B, H, W) uint8."""
        # Each pair on its own: what a solver finds must not depend on the pair before.
        return np.stack([self._solver.calc(a, b, None) for a, b in zip(first, second, strict=True)])

    def settings(self) -> str:
        """All that a flow depends on beside the images; another OpenCV may solve otherwise."""
        solver = self._solver
        numbers = (
            solver.getFinestScale(),
            solver.getPatchSize(),
            solver.getPatchStride(),
            solver.getGradientDescentIterations(),
            solver.getVariationalRefinementIterations(),
        )
        return f"dis {self._preset} {numbers} opencv {cv2.__version__}"

    @cached_property
    def net(self) -> "nn.Module":
        """Nothing, as a module."""
        require_torch("training with frontend=dis")
        from torch import nn

        return nn.Identity()

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """Its name alone."""
        return {"part": "dis"}

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Flow of every pair of a batch, as streaming finds it.

        Args:
            batch: with images in [0, 1].
            upstream: not used.

        Returns:
            ``"flow"``: (B, S, 2, H, W) px.
        """
        from vioframe_flow.batches import flow_of_batch

        return {FLOW: flow_of_batch(self, batch)}

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """None: there is nothing to learn."""
        return {}
