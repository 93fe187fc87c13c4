"""``frontend=tvnet``: TV-L1 unrolled into a network, as a front end and as a part that can be trained."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING

import numpy as np

from vioframe.interfaces import FLOW
from vioframe.learning.holder import NetHolder
from vioframe.types import SensorRig
from vioframe.vision.flow_levels import LEVELS_A_SIDE, ZERO_LEVEL
from vioframe_flow.frontend import FlowFrontend, require

if TYPE_CHECKING:
    from torch import Tensor

    from vioframe.learning.batch import WindowBatch
    from vioframe_flow.net import TvNet


@dataclass(frozen=True, slots=True, kw_only=True)
class _NetOptions:
    """Arguments of :class:`vioframe_flow.net.TvNet`, under their names there."""

    dual_step: float
    data_weight: float
    coupling: float
    warps: int
    iterations: int
    zoom: float
    max_scales: int
    smoothing_px: float
    trust_outside: bool
    learn_constants: bool
    start_grid: tuple[int, int] | None

    def __post_init__(self) -> None:
        for name in ("dual_step", "data_weight", "coupling"):
            require(name, getattr(self, name), getattr(self, name) > 0.0, "positive")
        for name in ("warps", "iterations", "max_scales"):
            require(name, getattr(self, name), getattr(self, name) >= 1, "at least 1")
        require("zoom", self.zoom, 0.1 <= self.zoom <= 0.95, "from 0.1 to 0.95")
        require("smoothing_px", self.smoothing_px, self.smoothing_px >= 0.0, "not negative")
        if self.start_grid is not None:
            whole = len(self.start_grid) == 2 and all(isinstance(n, int) and n >= 1 for n in self.start_grid)
            require("start_grid", list(self.start_grid), whole, "[rows, columns], whole numbers of at least 1, or null")


class TvnetFrontend(FlowFrontend):
    """TV-L1 flow by unrolled iterations (Fan et al. 2018); with untrained weights classical TV-L1.

    Args:
        size_px: (width, height) to which images are brought first, and the size of the flow; None keeps the image.
        dual_step: τ.
        data_weight: λ, for images that span 0 … 255.
        coupling: θ.
        warps: linearisations a scale.
        iterations: steps a warp.
        zoom: size of a scale by the one below it.
        max_scales: of the pyramid.
        smoothing_px: standard deviation of the Gaussian that images pass first; 0 leaves it out.
        trust_outside: let what is sought beyond the border pull at the flow.
        learn_constants: training may change τ, λ and θ, too.
        start_grid: (rows, columns) of a learned flow to start from, stretched over any image; None starts from zero.
        own_loss: train by the energy of TV-L1; False trains only through the parts after it.
        weights: file of trained weights, in MLflow too, or None for those of classical TV-L1.
        device: ``cpu``, ``cuda``, or ``auto`` for the latter where there is one.
        batch: most pairs solved at once by :meth:`process_many`.
        quantise: round flow to 256 levels.
        bound: flow at the last of them, as a share of the image's width.
        cache: folder in which flows are kept, or None.

    Raises:
        ConfigError: an option outside its range, a GPU that is not there, or torch is missing.
    """

    context_pairs = 1
    # Its first weights make it classical TV-L1.
    needs_training = False

    def __init__(
        self,
        *,
        size_px: Sequence[int] | None = (512, 256),
        dual_step: float = 0.25,
        data_weight: float = 0.15,
        coupling: float = 0.6,
        warps: int = 5,
        iterations: int = 10,
        zoom: float = 0.5,
        max_scales: int = 7,
        smoothing_px: float = 0.5,
        trust_outside: bool = False,
        learn_constants: bool = False,
        start_grid: Sequence[int] | None = None,
        own_loss: bool = True,
        weights: str | None = None,
        device: str = "auto",
        batch: int = 4,
        quantise: bool = True,
        bound: float = 0.09375,
        cache: str | None = None,
    ) -> None:
        super().__init__(name="tvnet", size_px=size_px, quantise=quantise, bound=bound, cache=cache, batch=batch)
        self._options = _NetOptions(
            dual_step=dual_step,
            data_weight=data_weight,
            coupling=coupling,
            warps=warps,
            iterations=iterations,
            zoom=zoom,
            max_scales=max_scales,
            smoothing_px=smoothing_px,
            trust_outside=trust_outside,
            learn_constants=learn_constants,
            start_grid=None if start_grid is None else tuple(start_grid),  # type: ignore[arg-type]  # checked there
        )
        # Its first weights make it classical TV-L1.
        self._holder = NetHolder(self, "frontend", "tvnet", self._make_net, weights, device, works_untrained=True)
        self._own_loss = own_loss

    def _make_net(self) -> "TvNet":
        from vioframe_flow.net import TvNet

        return TvNet(**asdict(self._options))

    @property
    def net(self) -> "TvNet":
        """The network; made when first asked for, since torch takes seconds to import.

        Raises:
            ConfigError: there is no such file of weights.
            DataError: the file is of another architecture, or damaged.
        """
        net: TvNet = self._holder.net  # type: ignore[assignment]  # it made it
        return net

    @property
    def architecture(self) -> Mapping[str, str | int | float | bool]:
        """What a file of weights must agree with: the numbers of kernels, and the grid of the start."""
        rows, columns = self._options.start_grid or (0, 0)
        return {
            "part": "tvnet",
            "warps": self._options.warps,
            "iterations": self._options.iterations,
            "start_rows": rows,
            "start_columns": columns,
        }

    def setup(self, rig: SensorRig) -> None:
        """Forget the last image and bring the net to its device; errors as of the interface."""
        self._holder.prepare()
        super().setup(rig)

    def solve(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Flow (B, H, W, 2) float32 px of pairs of grey images (B, H, W) uint8, all at once."""
        import torch

        device = next(self.net.parameters()).device
        with torch.inference_mode():
            pair = [torch.from_numpy(images).to(device)[:, None].float() for images in (first, second)]
            flow: np.ndarray = self.net(*pair).permute(0, 2, 3, 1).contiguous().cpu().numpy()
        return flow

    def settings(self) -> str:
        """All that a flow depends on beside the images: options and weights."""
        digest = blake2b(digest_size=16)
        for name, tensor in sorted(self.net.state_dict().items()):
            digest.update(name.encode() + tensor.detach().cpu().numpy().tobytes())
        return f"tvnet {asdict(self._options)} weights {digest.hexdigest()}"

    def forward_batch(self, batch: "WindowBatch", upstream: "Mapping[str, Tensor]") -> "dict[str, Tensor]":
        """Flow of every pair of a batch; from the cache, if there is one and nothing of the net is being trained.

        Args:
            batch: with images in [0, 1], best of ``size_px`` already: others are brought to it, nearly as streaming
                does.
            upstream: not used.

        Returns:
            ``"flow"``: (B, S, 2, H, W) px, on 256 levels if quantised, through which gradients pass unchanged.
        """
        if self._cache_folder is not None and not any(each.requires_grad for each in self.net.parameters()):
            from vioframe_flow.batches import flow_of_batch

            return {FLOW: flow_of_batch(self, batch)}
        import torch

        from vioframe_flow.net import split_pairs

        # Half precision has one grey level in eight digits, too few for slopes.
        with torch.autocast(batch.images.device.type, enabled=False):
            flow = self.net(*split_pairs(batch.images, self._size))
        if self._quantise:
            step = self._bound * flow.shape[-1] / LEVELS_A_SIDE
            levels = (flow.detach() / step).round().clamp(-ZERO_LEVEL, LEVELS_A_SIDE)
            flow = flow + (levels * step - flow).detach()
        return {FLOW: flow.reshape(len(batch), batch.pairs, *flow.shape[1:])}

    def loss(self, outputs: "Mapping[str, Tensor]", batch: "WindowBatch") -> "dict[str, Tensor]":
        """The energy of TV-L1, λ mean|I₂(x + u) − I₁| + mean(|∇u₁| + |∇u₂|); empty unless ``own_loss``."""
        if not self._own_loss:
            return {}
        import torch

        from vioframe_flow.net import photometric_loss, split_pairs

        with torch.autocast(batch.images.device.type, enabled=False):
            first, second = self.net.prepare(*split_pairs(batch.images, self._size))
            # The weight of the energy stays what it was: a learned one would make itself small.
            return {"loss": photometric_loss(first, second, outputs[FLOW].flatten(0, 1), self._options.data_weight)}
