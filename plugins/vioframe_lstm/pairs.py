"""What camera and inertial sensor say of each pair of consecutive images, in the axes of the body.

Nothing here is learned, so it is numpy in training too: both heads begin here, with a batch or with one window of a
stream, and a stream is answered as the batch was.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.geometry import so3
from vioframe.types import Measurement
from vioframe_lstm.options import Unstated

if TYPE_CHECKING:
    from torch import Tensor

    from vioframe.learning.batch import WindowBatch


@dataclass(frozen=True, kw_only=True, eq=False)
class Pairs:
    """Pairs in a row (B, S); what a sensor did not give is zero, a rotation the identity.

    Attributes:
        duration_s: (B, S).
        R_visual: (B, S, 3, 3) rotation of the body as the VO has it, and t_camera (B, S, 3) m, shift of the camera,
            both in the body at the earlier image.
        log_variances: (B, S, 6) ln rad² and ln m² that the VO states, in axes of the body, or that stand in for them.
        visual: (B, S), the VO stands by its motion.
        turn: (B, S, 3) rad, the gyro's rotation vector, bias included.
        push: (B, S, 3) m/s, integral of the specific force in the body at the earlier image.
        inertial: (B, S), samples reach over the whole pair.
        T_body_cam: (B, 4, 4).
    """

    duration_s: Array
    R_visual: Array
    t_camera: Array
    log_variances: Array
    visual: Mask
    turn: Array
    push: Array
    inertial: Mask
    T_body_cam: Array

    def __len__(self) -> int:
        """S."""
        return int(self.duration_s.shape[1])

    def of_pairs(self, change: Callable[[np.ndarray], np.ndarray], *, each: int = 1) -> Self:
        """The same with every array of the pairs changed, by which each row of the batch became ``each`` rows."""
        changed = {one.name: change(getattr(self, one.name)) for one in fields(self) if one.name != "T_body_cam"}
        return type(self)(**changed, T_body_cam=np.repeat(self.T_body_cam, each, axis=0))

    def without(self, visual: Mask, inertial: Mask) -> Self:
        """The same as if a sensor had given nothing where a mask (B, S) says so."""
        keeps_visual, keeps_inertial = ~visual, ~inertial
        return type(self)(
            duration_s=self.duration_s,
            R_visual=np.where(keeps_visual[..., None, None], self.R_visual, np.eye(3)),
            t_camera=self.t_camera * keeps_visual[..., None],
            log_variances=self.log_variances * keeps_visual[..., None],
            visual=self.visual & keeps_visual,
            turn=self.turn * keeps_inertial[..., None],
            push=self.push * keeps_inertial[..., None],
            inertial=self.inertial & keeps_inertial,
            T_body_cam=self.T_body_cam,
        )

    @cached_property
    def R_gyro(self) -> Array:
        """(B, S, 3, 3); the identity where there are no samples."""
        return so3.exp(self.turn)

    @cached_property
    def R_body(self) -> Array:
        """(B, S, 3, 3) rotation of the body by the gyro, by the VO where there are no samples."""
        return np.where(self.inertial[..., None, None], self.R_gyro, self.R_visual)

    @cached_property
    def lever(self) -> Array:
        """(B, S, 3) m, what the camera shifts because the body turns: ``(R − I) p_body_cam``."""
        p_body_cam = self.T_body_cam[:, None, :3, 3]
        return turned(self.R_body, p_body_cam) - p_body_cam

    @cached_property
    def t_body(self) -> Array:
        """(B, S, 3) m, shift of the body itself as the VO has it: the gyro's rotation takes the lever arm off."""
        return (self.t_camera - self.lever) * self.visual[..., None]

    @cached_property
    def disagreement(self) -> Array:
        """``Log(R_gyroᵀ R_vo)`` (B, S, 3) rad: zero where one of the two is missing."""
        both = (self.visual & self.inertial)[..., None]
        apart: Array = so3.log(transposed(self.R_gyro) @ self.R_visual) * both
        return apart

    def t_camera_of(self, t_body: Array) -> Array:
        """Shift (B, S, 3) m of the camera, in its own axes at the earlier image, of a shift of the body."""
        return turned(transposed(self.T_body_cam[:, None, :3, :3]), t_body + self.lever)

    def R_camera_of(self, R_body: Array) -> Array:
        """Rotation (B, S, 3, 3) of the camera of one of the body."""
        R_body_cam = self.T_body_cam[:, None, :3, :3]
        return transposed(R_body_cam) @ R_body @ R_body_cam


def pairs_of_batch(batch: "WindowBatch", upstream: "Mapping[str, Tensor]", unstated: Unstated) -> Pairs:
    """The pairs of a batch that the VO answered for, the last ones of each window.

    Args:
        batch: inertial samples and calibration.
        upstream: ``"T_prev_cur"`` (B, S', 4, 4) of the camera, and, where there are, ``"valid"`` (B, S'),
            ``"covariance"`` (B, S', 6, 6) or ``"log_variances"`` (B, S', 6).
        unstated: what stands in for what is not stated.
    """
    T_prev_cur = upstream["T_prev_cur"]
    count = T_prev_cur.shape[1]
    covariance = upstream.get("covariance")
    if covariance is None and "log_variances" in upstream:
        from vioframe.learning.motion import covariance_from_log_variances, vector_from_motion

        covariance = covariance_from_log_variances(vector_from_motion(T_prev_cur), upstream["log_variances"])
    valid = upstream.get("valid")
    stamps_ns = batch.stamps_ns[:, -count - 1 :].cpu().numpy()
    return make_pairs(
        T_prev_cur=doubles(T_prev_cur),
        covariance=None if covariance is None else doubles(covariance),
        valid=np.ones(T_prev_cur.shape[:2], dtype=np.bool_) if valid is None else valid.cpu().numpy(),
        imu=doubles(batch.imu[:, -count:]),
        imu_time_s=doubles(batch.imu_time_s[:, -count:]),
        imu_mask=batch.imu_mask[:, -count:].cpu().numpy(),
        duration_s=np.diff(stamps_ns, axis=1) / NANOSECONDS,
        T_body_cam=doubles(batch.rig.T_body_cam),
        unstated=unstated,
    )


def pair_of(measurement: Measurement, T_body_cam: Array, unstated: Unstated) -> Pairs:
    """The pair (1, 1) of a window of a stream."""
    window, pose = measurement.window, measurement.relative_pose
    if pose is not None and not pose.valid:
        pose = None
    samples, times = samples_of(measurement)
    # A hole that somebody filled is a hole.
    whole = window.gap_ns <= unstated.longest_gap_s * NANOSECONDS
    return make_pairs(
        T_prev_cur=(np.eye(4) if pose is None else pose.T_prev_cur)[None, None],
        covariance=None if pose is None or pose.covariance is None else pose.covariance[None, None],
        valid=np.array([[pose is not None]]),
        imu=samples,
        imu_time_s=times,
        imu_mask=np.full(times.shape, whole),
        duration_s=np.array([[seconds(window.current.stamp_ns - window.previous.stamp_ns)]]),
        T_body_cam=T_body_cam[None],
        unstated=unstated,
    )


def samples_of(measurement: Measurement) -> tuple[Array, Array]:
    """Samples (1, 1, K, 6) and times (1, 1, K) s since the window's start."""
    imu = measurement.window.imu
    times = (imu.stamps_ns - measurement.window.previous.stamp_ns) / NANOSECONDS
    return np.concatenate([imu.gyro, imu.accel], axis=1)[None, None], times[None, None]


def make_pairs(
    *,
    T_prev_cur: Array,
    covariance: Array | None,
    valid: Mask,
    imu: Array,
    imu_time_s: Array,
    imu_mask: Mask,
    duration_s: Array,
    T_body_cam: Array,
    unstated: Unstated,
) -> Pairs:
    """Bring what the sensors said (shapes as in ``WindowBatch`` and ``VisualBatch``) into the axes of the body."""
    visual = valid & np.isfinite(T_prev_cur).all(axis=(-1, -2))
    R_body_cam = T_body_cam[:, None, :3, :3]
    T_sound = np.where(visual[..., None, None], T_prev_cur, np.eye(4))
    steps = integrated(imu, imu_time_s, imu_mask)
    longest = steps.lengths_s.max(axis=-1, initial=0.0)
    inertial = (longest > 0.0) & (longest <= unstated.longest_gap_s)
    return Pairs(
        duration_s=duration_s,
        R_visual=R_body_cam @ T_sound[..., :3, :3] @ transposed(R_body_cam),
        t_camera=turned(R_body_cam, T_sound[..., :3, 3]),
        log_variances=_log_variances(covariance, T_sound, R_body_cam, unstated) * visual[..., None],
        visual=visual,
        turn=_last(steps.turned) * inertial[..., None],
        push=steps.gains.sum(axis=-2) * inertial[..., None],
        inertial=inertial,
        T_body_cam=T_body_cam,
    )


def _log_variances(covariance: Array | None, T_prev_cur: Array, R_body_cam: Array, unstated: Unstated) -> Array:
    squared = (T_prev_cur[..., :3, 3] ** 2).sum(axis=-1)
    spread = unstated.translation_sigma**2 + unstated.translation_ratio**2 * squared
    variances = np.repeat(np.stack([np.full_like(spread, unstated.rotation_sigma**2), spread], axis=-1), 3, axis=-1)
    if covariance is not None:
        blocks = [covariance[..., :3, :3], covariance[..., 3:, 3:]]
        stated = np.concatenate(
            [np.diagonal(R_body_cam @ block @ transposed(R_body_cam), axis1=-2, axis2=-1) for block in blocks], axis=-1
        )
        variances = np.where((stated > 0.0) & np.isfinite(stated), stated, variances)
    logarithms: Array = np.log(np.maximum(variances, 1e-16))
    return logarithms


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Steps:
    """From sample to sample, K − 1 steps a pair.

    Attributes:
        turned: (B, S, K − 1, 3) rad, rotation vector since the first sample, after each step.
        gains: (B, S, K − 1, 3) m/s, what each adds to the integral of the specific force, in the body at the first.
        lengths_s: (B, S, K − 1), zero where there is no sample.
    """

    turned: Array
    gains: Array
    lengths_s: Array


def integrated(imu: Array, time_s: Array, mask: Mask) -> Steps:
    """Integrate samples (B, S, K, 6), taken as linear in between.

    Rotations are added with the second-order term of Baker, Campbell and Hausdorff, which leaves a part of third order
    in the turn of a pair.
    """
    lengths = np.diff(time_s, axis=-1) * (mask[..., 1:] & mask[..., :-1])
    mean = 0.5 * (imu[..., 1:, :] + imu[..., :-1, :]) * lengths[..., None]
    turns, pushes = mean[..., :3], mean[..., 3:]
    added = np.cumsum(turns + 0.5 * np.cross(np.cumsum(turns, axis=-2) - turns, turns), axis=-2)
    return Steps(turned=added, gains=turned(so3.exp(added - 0.5 * turns), pushes), lengths_s=lengths)


def joined(parts: Sequence[Pairs]) -> Pairs:
    """Pairs of one rig put in a row."""
    merged = {
        each.name: np.concatenate([getattr(part, each.name) for part in parts], axis=1)
        for each in fields(Pairs)
        if each.name != "T_body_cam"
    }
    return Pairs(**merged, T_body_cam=parts[0].T_body_cam)


def lose_stretches(pairs: Pairs, share: float, longest: int, rng: np.random.Generator) -> Pairs:
    """Take a stretch of the VO's answers from ``share`` of the windows, and of the inertial samples from as many.

    Args:
        pairs: (B, S).
        share: probability of either.
        longest: pairs; lengths are drawn evenly from 1.
        rng: of the draws.
    """
    count, length = pairs.visual.shape
    place = np.arange(length)

    def drawn() -> Mask:
        lost = rng.random((count, 1)) < share
        first, size = rng.integers(-longest + 1, length, (count, 1)), rng.integers(1, longest + 1, (count, 1))
        inside: Mask = lost & (place >= first) & (place < first + size)
        return inside

    return pairs.without(drawn(), drawn())


def attitudes(R_prev_cur: Array) -> Array:
    """Products R_0_k (B, S, 3, 3) of rotations in a row, k = 1 … S, by doubling the stretches that are multiplied."""
    products, step = R_prev_cur, 1
    while step < products.shape[1]:
        products = np.concatenate([products[:, :step], products[:, :-step] @ products[:, step:]], axis=1)
        step *= 2
    return products


def held_shifts(pairs: Pairs, shifts: Array) -> Array:
    """Shifts (B, S, 3) with those of the last known speed where the VO is silent; none before the first."""
    number = np.where(pairs.visual, np.arange(len(pairs)), 0)
    last = np.maximum.accumulate(number, axis=1)[..., None]
    speed = shifts / pairs.duration_s[..., None]
    held: Array = np.take_along_axis(speed, last, axis=1) * pairs.duration_s[..., None]
    return held


def turned(R: Array, vectors: Array) -> Array:
    """Vectors (..., 3) by rotations (..., 3, 3)."""
    out: Array = (R @ vectors[..., None])[..., 0]
    return out


def transposed(R: Array) -> Array:
    """The inverse of rotations (..., 3, 3)."""
    return np.swapaxes(R, -1, -2)


def doubles(tensor: "Tensor") -> Array:
    """A tensor as an array in double precision."""
    out: Array = tensor.detach().cpu().double().numpy()
    return out


def _last(values: Array) -> Array:
    """The last along the second axis from the end; zero where there is none."""
    if values.shape[-2] == 0:
        return np.zeros((*values.shape[:-2], values.shape[-1]))
    return values[..., -1, :]
