"""What the nets of an experiment weigh, for its record: parameters, and multiply-accumulates of one more image.

The layers that cost something only tell the shapes of what they would answer, so it takes a fraction of a second
whatever the size of the net. Importing this module does not import torch.
"""

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING

from vioframe.conventions import NANOSECONDS
from vioframe.errors import VioframeError
from vioframe.interfaces import FLOW, HasNet, Trainable

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from vioframe.learning.batch import WindowBatch

log = logging.getLogger(__name__)

_SIZE_PX = (512, 256)
_STEP_NS = NANOSECONDS // 10
# What code says that wants another kind of batch, or more than this one has.
_REFUSALS = (VioframeError, RuntimeError, ValueError, TypeError, LookupError, AttributeError)


def model_figures(parts: Mapping[str, object], size_px: tuple[int, int] | None = None) -> dict[str, float]:
    """Size and cost of the parts with a net, for ``metrics.json`` (under ``"model"``) and for comparing runs.

    Args:
        parts: of the pipeline, by slot, in its order; those without anything to learn are passed over.
        size_px: (width, height) of the images; a part whose ``architecture`` has ``width_px`` and ``height_px`` gets
            images of that size. None: 512×256.

    Returns:
        ``"parameters"`` and ``"gmac"`` of all together, and ``"<slot>.parameters"`` and ``"<slot>.gmac"`` of each.
        GMAC: 1e9 multiply-accumulates of convolutions, linear and LSTM layers for one more image, as
        :mod:`vioframe.learning.counting` has them. There is none of a part with layers that cannot be counted, such as
        an unrolled solver, that refuses a blank batch, or that is trained on something else than windows of a
        recording. Empty where no part has a net.
    """
    nets = {slot: part for slot, part in parts.items() if isinstance(part, HasNet)}
    if not nets:
        return {}
    from vioframe.learning.counting import parameters_of

    figures: dict[str, float] = {}
    known: dict[str, Tensor] = {}
    for slot, part in nets.items():
        count = parameters_of(part.net)
        if count == 0:
            continue
        figures[f"{slot}.parameters"] = float(count)
        if not isinstance(part, Trainable):
            continue
        macs = _macs_of_one_more(part, slot, size_px or _SIZE_PX, known)
        if macs is not None:
            figures[f"{slot}.gmac"] = macs / 1e9
    for name in ("parameters", "gmac"):
        each = [value for key, value in figures.items() if key.endswith(f".{name}")]
        if each:
            figures[name] = sum(each)
    return figures


def _macs_of_one_more(part: Trainable, slot: str, size_px: tuple[int, int], known: "dict[str, Tensor]") -> int | None:
    """What a window costs that is one pair longer, beyond a window of as many pairs as the part looks back at.

    ``known`` takes up what the part returns, for those after it.
    """
    import torch

    from vioframe.learning.counting import counting, idling

    described = part.architecture
    width, height = (
        int(described.get(f"{side}_px", size)) for side, size in zip(("width", "height"), size_px, strict=True)
    )
    device = next(part.net.parameters()).device
    training = part.net.training
    counted: list[int] = []
    try:
        part.net.eval()
        for pairs in (part.context_pairs, part.context_pairs + 1):
            flow = torch.zeros(1, pairs, 2, height, width, device=device)
            with torch.inference_mode(), counting(part.net) as work, idling(part.net):
                if work.uncounted:
                    return None
                outputs = part.forward_batch(_blank_batch(pairs, width, height, device), {FLOW: flow, **known})
            counted.append(work.macs)
    except _REFUSALS as error:
        log.debug("multiply-accumulates of %s are not counted: %s", slot, error)
        return None
    finally:
        part.net.train(training)
    known.update(outputs)
    return counted[1] - counted[0]


def _blank_batch(pairs: int, width: int, height: int, device: "torch.device") -> "WindowBatch":
    """One window of black images in colour, at rest, with ten inertial samples a pair."""
    import torch

    from vioframe.learning.batch import RigBatch, WindowBatch

    images, samples = pairs + 1, 10
    with device:
        return WindowBatch(
            images=torch.zeros(1, images, 3, height, width),
            T_prev_cur=torch.eye(4).expand(1, pairs, 4, 4),
            stamps_ns=torch.arange(images)[None] * _STEP_NS,
            imu=torch.zeros(1, pairs, samples, 6),
            imu_time_s=torch.linspace(0.0, _STEP_NS / NANOSECONDS, samples).expand(1, pairs, samples),
            imu_mask=torch.ones(1, pairs, samples, dtype=torch.bool),
            rig=RigBatch(
                intrinsics_px=torch.tensor([[width, width, width / 2, height / 2]]),
                T_body_cam=torch.eye(4)[None],
                gravity=torch.full((1,), 9.81),
            ),
            velocity_body=torch.zeros(1, images, 3),
            gravity_body=torch.tensor([0.0, 0.0, -9.81]).expand(1, images, 3),
            recording=torch.zeros(1, dtype=torch.int64),
            start=torch.zeros(1, dtype=torch.int64),
        )
