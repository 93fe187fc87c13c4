"""What a net is trained on: windows of consecutive images with the true motion between them, as tensors.

Every tensor begins with the batch axis B; what belongs to a pair of consecutive images has the sequence axis S next,
what belongs to an image S + 1.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from vioframe.data.windows import TrainingWindow
from vioframe.errors import ShapeError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigBatch:
    """Calibration of camera 0 and the place of the sensors, one a window: augmentation may mirror it.

    Attributes:
        intrinsics_px: (B, 4) fx, fy, cx, cy of the images as they are in the batch, resized.
        T_body_cam: (B, 4, 4).
        gravity: (B,) m/s².
    """

    intrinsics_px: Tensor
    T_body_cam: Tensor
    gravity: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VisualBatch:
    """What a VO answered for the pairs of each window, with fields as of :class:`vioframe.data.windows.PairAnswers`.

    Attributes:
        T_prev_cur: (B, S, 4, 4) motion of camera 0, metres.
        covariance: (B, S, 6, 6), zero where none was stated.
        valid: (B, S) bool.
    """

    T_prev_cur: Tensor
    covariance: Tensor
    valid: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowBatch:
    """B windows of S pairs of consecutive images of camera 0.

    Attributes:
        images: (B, S + 1, C, H, W), C = 1 or 3 (RGB). Floating point in [0, 1] where a net sees them; uint8 on the
            way to the device, see :meth:`as_float`. H = W = 0 where nothing that is trained sees images.
        T_prev_cur: (B, S, 4, 4) true motion of camera 0 over each pair, metres: the target.
        stamps_ns: (B, S + 1) int64, IMU clock (mirrored in time where a window was reversed).
        imu: (B, S, N, 6) gyro rad/s and specific force m/s² in the body; the first and the last valid sample of a pair
            lie exactly at its two images. N = 0 where a recording has no inertial samples.
        imu_time_s: (B, S, N) seconds since the first image of the pair.
        imu_mask: (B, S, N) bool, True for a sample, False for padding, which follows the samples.
        rig: calibration.
        velocity_body: (B, S + 1, 3) m/s, true velocity of the body at the images, in the body.
        gravity_body: (B, S + 1, 3) m/s², true gravity, which points down, in the body.
        vo: what a VO answered for the pairs, or None where it is trained or asked along.
        recording: (B,) int64, which recording of the split.
        start: (B,) int64, number of the window's first image among the recording's frames.
    """

    images: Tensor
    T_prev_cur: Tensor
    stamps_ns: Tensor
    imu: Tensor
    imu_time_s: Tensor
    imu_mask: Tensor
    rig: RigBatch
    velocity_body: Tensor
    gravity_body: Tensor
    recording: Tensor
    start: Tensor
    vo: VisualBatch | None = None

    def __post_init__(self) -> None:
        if self.images.ndim != 5 or self.images.shape[1] < 2 or self.images.shape[2] not in (1, 3):
            raise ShapeError(
                "WindowBatch.images must have shape (B, S + 1, 1 or 3, H, W) with S ≥ 1, "
                f"got {tuple(self.images.shape)}"
            )
        if self.images.dtype != torch.uint8 and not self.images.is_floating_point():
            raise ShapeError(f"WindowBatch.images must be uint8 or floating point in [0, 1], got {self.images.dtype}")
        count, pairs = self.images.shape[0], self.images.shape[1] - 1
        samples = self.imu.shape[2] if self.imu.ndim == 4 else -1
        wanted: dict[str, tuple[Tensor, tuple[int, ...]]] = {
            "T_prev_cur": (self.T_prev_cur, (count, pairs, 4, 4)),
            "stamps_ns": (self.stamps_ns, (count, pairs + 1)),
            "imu": (self.imu, (count, pairs, samples, 6)),
            "imu_time_s": (self.imu_time_s, (count, pairs, samples)),
            "imu_mask": (self.imu_mask, (count, pairs, samples)),
            "rig.intrinsics_px": (self.rig.intrinsics_px, (count, 4)),
            "rig.T_body_cam": (self.rig.T_body_cam, (count, 4, 4)),
            "rig.gravity": (self.rig.gravity, (count,)),
            "velocity_body": (self.velocity_body, (count, pairs + 1, 3)),
            "gravity_body": (self.gravity_body, (count, pairs + 1, 3)),
            "recording": (self.recording, (count,)),
            "start": (self.start, (count,)),
        }
        if self.vo is not None:
            wanted["vo.T_prev_cur"] = (self.vo.T_prev_cur, (count, pairs, 4, 4))
            wanted["vo.covariance"] = (self.vo.covariance, (count, pairs, 6, 6))
            wanted["vo.valid"] = (self.vo.valid, (count, pairs))
        for name, (value, shape) in wanted.items():
            if tuple(value.shape) != shape:
                raise ShapeError(f"WindowBatch.{name} must have shape {shape}, got {tuple(value.shape)}")

    def __len__(self) -> int:
        return self.images.shape[0]

    @property
    def pairs(self) -> int:
        """S, pairs of images in each window."""
        return self.images.shape[1] - 1

    def as_float(self) -> Self:
        """The same batch with images in [0, 1]; done on the device, since bytes travel four times as fast."""
        if self.images.is_floating_point():
            return self
        return replace(self, images=self.images.to(torch.float32) / 255.0)

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> Self:
        """The same batch on another device."""
        return self._map(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def first(self) -> Self:
        """Its first window, as a batch of one."""
        return self._map(lambda tensor: tensor[:1])

    def pin_memory(self) -> Self:
        """The same batch in page-locked memory; a DataLoader calls it by this name."""
        return self._map(lambda tensor: tensor.pin_memory())

    def _map(self, change: Callable[[Tensor], Tensor]) -> Self:
        moved = {
            each.name: _changed(getattr(self, each.name), change)
            for each in fields(self)
            if getattr(self, each.name) is not None
        }
        return replace(self, **moved)


def _changed(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(value, Tensor):
        return change(value)
    return replace(value, **{each.name: change(getattr(value, each.name)) for each in fields(value)})


def collate(windows: Sequence[TrainingWindow]) -> WindowBatch:
    """Stack windows, padding their inertial samples to the most that any pair has.

    Args:
        windows: at least one, all with the same number of images and the same image size.

    Raises:
        ShapeError: sizes differ, or some windows have the answers of a VO and others have not.
    """
    shapes = {window.images.shape for window in windows}
    if len(shapes) != 1:
        raise ShapeError(f"windows of one batch must have images of one shape, got {sorted(shapes)}")
    count, pairs = len(windows), windows[0].pairs
    longest = max((len(block) for window in windows for block in window.imu_time_s), default=0)
    imu = np.zeros((count, pairs, longest, 6), dtype=np.float32)
    time_s = np.zeros((count, pairs, longest), dtype=np.float32)
    mask = np.zeros((count, pairs, longest), dtype=np.bool_)
    for index, window in enumerate(windows):
        for pair, (samples, times) in enumerate(zip(window.imu, window.imu_time_s, strict=True)):
            imu[index, pair, : len(times)] = samples
            time_s[index, pair, : len(times)] = times
            mask[index, pair, : len(times)] = True
    # Images are kept with channels last, as they are decoded; a convolution wants them before height and width.
    images = np.stack([window.images for window in windows]).transpose(0, 1, 4, 2, 3)
    answers = [window.vo for window in windows if window.vo is not None]
    if answers and len(answers) != count:
        raise ShapeError("windows of one batch must all have the answers of a VO, or none of them")
    return WindowBatch(
        images=torch.from_numpy(np.ascontiguousarray(images)),
        T_prev_cur=_floats([window.T_prev_cur for window in windows]),
        stamps_ns=torch.from_numpy(np.stack([window.stamps_ns for window in windows])),
        imu=torch.from_numpy(imu),
        imu_time_s=torch.from_numpy(time_s),
        imu_mask=torch.from_numpy(mask),
        rig=RigBatch(
            intrinsics_px=_floats([window.intrinsics_px for window in windows]),
            T_body_cam=_floats([window.T_body_cam for window in windows]),
            gravity=torch.tensor([window.gravity for window in windows], dtype=torch.float32),
        ),
        velocity_body=_floats([window.velocity_body for window in windows]),
        gravity_body=_floats([window.gravity_body for window in windows]),
        vo=VisualBatch(
            T_prev_cur=_floats([each.T_prev_cur for each in answers]),
            covariance=_floats([each.covariance for each in answers]),
            valid=torch.from_numpy(np.stack([each.valid for each in answers])),
        )
        if answers
        else None,
        recording=torch.tensor([window.recording for window in windows], dtype=torch.int64),
        start=torch.tensor([window.start for window in windows], dtype=torch.int64),
    )


def _floats(arrays: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32))
