"""Batches of training windows, solved by a front end that works on images of bytes."""

import torch
from torch import Tensor

from vioframe.learning.batch import WindowBatch
from vioframe_flow.frontend import FlowFrontend


def flow_of_batch(frontend: FlowFrontend, batch: WindowBatch) -> Tensor:
    """Flow (B, S, 2, H, W) px of every pair of a batch, on its device, without gradient."""
    images = batch.images.detach()
    if images.is_floating_point():
        images = (images * 255.0).round().clamp(0.0, 255.0).to(torch.uint8)
    # Channels last, as images are outside of networks; grey ones have none.
    whole = images.permute(0, 1, 3, 4, 2).cpu()
    flow = frontend.flow_batch((whole[..., 0] if whole.shape[-1] == 1 else whole).contiguous().numpy())
    return torch.from_numpy(flow).permute(0, 1, 4, 2, 3).to(batch.images.device).contiguous()
