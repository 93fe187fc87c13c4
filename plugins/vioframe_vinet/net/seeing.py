"""What the core sees, from a window of a stream and from a batch of windows: the same of the same numbers."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.learning.motion import inverse, product
from vioframe.types import SyncedWindow
from vioframe_vinet.net.core import Seen
from vioframe_vinet.net.inertial import Resampled, resample

if TYPE_CHECKING:
    from vioframe.learning.batch import WindowBatch


# Pairs of images: a sensor that has to be missed for longer teaches nothing new.
_LONGEST = 50


def seen_in_window(
    window: SyncedWindow, embedding: Array | None, T_axes_body: Tensor, *, size: int, intervals: int
) -> Seen:
    """One window of a stream, as a batch of one pair.

    Args:
        window: its samples may be none.
        embedding: (D,), or None where an image is missing.
        T_axes_body: (4, 4), from the body to the axes of the answer, on the net's device.
        size: D.
        intervals: to which the samples are brought.
    """
    device = T_axes_body.device
    samples = np.concatenate([window.imu.gyro, window.imu.accel], axis=1).astype(np.float32).reshape(1, -1, 6)
    since = ((window.imu.stamps_ns - window.previous.stamp_ns) / NANOSECONDS).astype(np.float32)
    time_s = torch.from_numpy(since).to(device)[None]
    blank = np.zeros(size) if embedding is None else embedding
    duration = seconds(window.current.stamp_ns - window.previous.stamp_ns)
    return Seen(
        embedding=torch.from_numpy(blank.astype(np.float32)).to(device)[None, None],
        visible=torch.tensor([[embedding is not None]], device=device),
        samples=_turned(
            resample(
                torch.from_numpy(samples).to(device), time_s, torch.ones_like(time_s, dtype=torch.bool), intervals
            ),
            T_axes_body[None],
        ),
        duration_s=torch.tensor([[duration]], dtype=torch.float32, device=device),
    )


def seen_in_batch(
    batch: "WindowBatch",
    embedding: Tensor,
    T_axes_body: Tensor,
    *,
    intervals: int,
    lost_images: float,
    lost_imu: float,
) -> Seen:
    """Windows to learn from, some of which lack a sensor for a while.

    Args:
        batch: of windows.
        embedding: (B, S, D).
        T_axes_body: (B, 4, 4), from the body to the axes of the answer.
        intervals: to which the samples are brought.
        lost_images: share of windows in which a stretch of pairs is left without images.
        lost_imu: likewise without inertial samples.
    """
    shape = (len(batch), batch.pairs)
    visible = ~stretches(*shape, lost_images).to(embedding.device)
    heard = ~stretches(*shape, lost_imu).to(embedding.device)
    mask = (batch.imu_mask & heard[..., None]).flatten(0, 1)
    samples = resample(batch.imu.flatten(0, 1), batch.imu_time_s.flatten(0, 1), mask, intervals)
    return Seen(
        embedding=embedding,
        visible=visible,
        samples=_turned(samples, T_axes_body[:, None].expand(-1, batch.pairs, -1, -1).flatten(0, 1)),
        duration_s=batch.stamps_ns.diff(dim=1).to(embedding.dtype) / NANOSECONDS,
    )


def stretches(windows: int, pairs: int, share: float) -> Tensor:
    """(B, S) bool, True where something is left out: one stretch in about this share of the windows.

    Torch's own generator draws, which a training seeds at each epoch.
    """
    if not share:
        return torch.zeros(windows, pairs, dtype=torch.bool)
    chosen = torch.rand(windows) < share
    first = (torch.rand(windows) * pairs).long()
    length = 1 + (torch.rand(windows) * (pairs - first).clamp_max(_LONGEST)).long()
    place = torch.arange(pairs)[None]
    return chosen[:, None] & (place >= first[:, None]) & (place < (first + length)[:, None])


def moved_to(axes: Tensor, motion: Tensor) -> Tensor:
    """Motions (..., 4, 4) of one frame as those of another that is fixed to it, by T_other_one (..., 4, 4)."""
    return product(product(axes, motion), inverse(axes))


def _turned(samples: Resampled, T_axes_body: Tensor) -> Resampled:
    """Samples of P pairs in the axes of ``T_axes_body`` (P, 4, 4)."""
    R = T_axes_body[:, None, :3, :3]
    vectors = samples.means.reshape(*samples.means.shape[:2], 2, 3)
    means = product(vectors, R.transpose(-1, -2))
    return samples._replace(means=means.flatten(-2))
