"""Raw inertial samples between two images: brought to one rate, turned by the gyro, and read by a small LSTM."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from vioframe.learning.motion import exp_so3, product

_SAMPLE = 6
"""Gyro, specific force."""
# Samples in these units are of the order of 1 for a car: rad/s, m/s².
_GYRO_UNIT, _ACCEL_UNIT = 0.2, 5.0


class Resampled(NamedTuple):
    """Inertial samples of P pairs at one rate.

    Attributes:
        means: (P, K, 6) mean gyro rad/s and specific force m/s² of K equal intervals; 0 where not heard.
        duration_s: (P,) from the first sample to the last; 0 where not heard.
        heard: (P,) bool, whether there are samples.
    """

    means: Tensor
    duration_s: Tensor
    heard: Tensor


def resample(imu: Tensor, time_s: Tensor, mask: Tensor, intervals: int) -> Resampled:
    """Means over equal intervals of samples that are linear in between, whatever their rate: integrals are kept.

    Args:
        imu: (P, N, 6) rad/s and m/s².
        time_s: (P, N) increasing, since the pair's first image.
        mask: (P, N) bool, True for a sample, False for padding, which follows the samples.
        intervals: K.
    """
    pairs, most = mask.shape
    count = mask.sum(1)
    heard = count >= 2
    if most < 2:
        return Resampled(imu.new_zeros(pairs, intervals, _SAMPLE), imu.new_zeros(pairs), heard)
    # Differences of sums over the whole pair: single precision would lose two digits of them.
    values, times = imu.double(), time_s.double()
    # Padding repeats the last sample, which adds nothing to an integral.
    last = torch.minimum(torch.arange(most, device=mask.device)[None], (count - 1).clamp_min(0)[:, None])
    times = times.gather(1, last)
    values = values.gather(1, last[..., None].expand(-1, -1, _SAMPLE))
    span = (times[:, -1] - times[:, 0]).clamp_min(0.0)
    heard = heard & (span > 0.0)
    steps = times.diff(dim=1)
    areas = 0.5 * (values[:, 1:] + values[:, :-1]) * steps[..., None]
    integral = torch.cat([torch.zeros_like(values[:, :1]), areas.cumsum(1)], dim=1)
    edges = torch.linspace(0.0, 1.0, intervals + 1, dtype=times.dtype, device=times.device)
    grid = (times[:, :1] + span[:, None] * edges).contiguous()
    before = (torch.searchsorted(times.contiguous(), grid, right=True) - 1).clamp(0, most - 2)
    at = before[..., None].expand(-1, -1, _SAMPLE)
    into = (grid - times.gather(1, before))[..., None]
    step = steps.gather(1, before)[..., None]
    rise = values.gather(1, at + 1) - values.gather(1, at)
    slope = torch.where(step > 0.0, rise / step.clamp_min(1e-12), torch.zeros_like(rise))
    passed = integral.gather(1, at) + values.gather(1, at) * into + 0.5 * slope * into**2
    means = passed.diff(dim=1) * (intervals / span.clamp_min(1e-12))[:, None, None]
    means = torch.where(heard[:, None, None], means, torch.zeros_like(means))
    duration = torch.where(heard, span, torch.zeros_like(span))
    return Resampled(means.to(imu.dtype), duration.to(imu.dtype), heard)


def turn_by_gyro(samples: Resampled) -> Tensor:
    """R_prev_cur (P, 3, 3) that the gyro tells, bias and all; the identity where it was not heard."""
    intervals = samples.means.shape[1]
    steps = exp_so3(samples.means[..., :3] * (samples.duration_s / intervals)[:, None, None])
    turn = steps[:, 0]
    for k in range(1, intervals):
        turn = product(turn, steps[:, k])
    return turn


class InertialEncoder(nn.Module):
    """A small LSTM over the samples of one pair, from rest each time: what lasts longer is the core's to remember."""

    def __init__(self, *, hidden: int, layers: int) -> None:
        """Build ``layers`` layers of ``hidden`` neurons."""
        super().__init__()
        self.lstm = nn.LSTM(_SAMPLE, hidden, layers, batch_first=True)

    def forward(self, means: Tensor) -> Tensor:
        """Features (P, hidden) of (P, K, 6), in rad/s and m/s²."""
        unit = means.new_tensor([_GYRO_UNIT] * 3 + [_ACCEL_UNIT] * 3)
        remembered, _ = self.lstm(means / unit)
        features: Tensor = remembered[:, -1]
        return features
