"""What camera and inertial sensor say of each pair of consecutive images, in the axes of the body.

Both heads begin here, in training with a batch and in use with one pair at a time, so that a stream is answered as
the batch was.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

from vioframe.learning.batch import WindowBatch
from vioframe.learning.motion import (
    covariance_from_log_variances,
    exp_so3,
    log_so3,
    product,
    vector_from_motion,
)
from vioframe_lstm.options import Unstated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pairs:
    """Pairs in a row (B, S); what a sensor did not give is zero, a rotation the identity.

    Attributes:
        duration_s: (B, S).
        R_visual: (B, S, 3, 3) rotation of the body as the VO has it, and t_camera (B, S, 3) m, shift of the camera,
            both in the body at the earlier image.
        log_variances: (B, S, 6) ln rad² and ln m² that the VO states, in axes of the body, or that stand in for them.
        visual: (B, S) bool, the VO stands by its motion.
        turn: (B, S, 3) rad, the gyro's rotation vector, bias included.
        push: (B, S, 3) m/s, integral of the specific force in the body at the earlier image.
        inertial: (B, S) bool, samples reach over the whole pair.
        T_body_cam: (B, 4, 4).
    """

    duration_s: Tensor
    R_visual: Tensor
    t_camera: Tensor
    log_variances: Tensor
    visual: Tensor
    turn: Tensor
    push: Tensor
    inertial: Tensor
    T_body_cam: Tensor

    def __len__(self) -> int:
        """S."""
        return self.duration_s.shape[1]

    def of_pairs(self, change: Callable[[Tensor], Tensor], *, each: int = 1) -> Self:
        """The same with every tensor of the pairs changed, by which each row of the batch became ``each`` rows."""
        changed = {one.name: change(getattr(self, one.name)) for one in fields(self) if one.name != "T_body_cam"}
        return type(self)(**changed, T_body_cam=self.T_body_cam.repeat_interleave(each, dim=0))

    def without(self, visual: Tensor, inertial: Tensor) -> Self:
        """The same as if a sensor had given nothing where a mask (B, S) says so."""
        keeps_visual, keeps_inertial = ~visual, ~inertial
        identity = torch.eye(3, dtype=self.R_visual.dtype, device=self.R_visual.device)
        return type(self)(
            duration_s=self.duration_s,
            R_visual=torch.where(keeps_visual[..., None, None], self.R_visual, identity),
            t_camera=self.t_camera * keeps_visual[..., None],
            log_variances=self.log_variances * keeps_visual[..., None],
            visual=self.visual & keeps_visual,
            turn=self.turn * keeps_inertial[..., None],
            push=self.push * keeps_inertial[..., None],
            inertial=self.inertial & keeps_inertial,
            T_body_cam=self.T_body_cam,
        )

    @property
    def R_body(self) -> Tensor:
        """(B, S, 3, 3) rotation of the body by the gyro, by the VO where there are no samples."""
        return torch.where(self.inertial[..., None, None], exp_so3(self.turn), self.R_visual)

    def lever(self) -> Tensor:
        """(B, S, 3) m, what the camera shifts because the body turns: ``(R − I) p_body_cam``."""
        p_body_cam = self.T_body_cam[:, None, :3, 3]
        return product(self.R_body, p_body_cam[..., None])[..., 0] - p_body_cam

    def t_body(self) -> Tensor:
        """(B, S, 3) m, shift of the body itself as the VO has it: the gyro's rotation takes the lever arm off."""
        return torch.where(self.visual[..., None], self.t_camera - self.lever(), torch.zeros_like(self.t_camera))

    def T_camera(self, R_body: Tensor, t_body: Tensor) -> Tensor:
        """Motion (B, S, 4, 4) of the camera of a rotation (B, S, 3, 3) and a shift (B, S, 3) of the body."""
        R_body_cam = self.T_body_cam[:, None, :3, :3]
        R_cam_body = R_body_cam.transpose(-1, -2)
        T = torch.zeros(*R_body.shape[:2], 4, 4, dtype=R_body.dtype, device=R_body.device)
        T[..., :3, :3] = product(product(R_cam_body, R_body), R_body_cam.expand_as(R_body))
        T[..., :3, 3] = product(R_cam_body, (t_body + self.lever())[..., None])[..., 0]
        T[..., 3, 3] = 1.0
        return T


def pairs_of_batch(batch: WindowBatch, upstream: Mapping[str, Tensor], unstated: Unstated) -> Pairs:
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
        covariance = covariance_from_log_variances(
            vector_from_motion(T_prev_cur), upstream["log_variances"][:, -count:]
        )
    elapsed_ns = batch.stamps_ns[:, 1:] - batch.stamps_ns[:, :-1]
    return make_pairs(
        T_prev_cur=T_prev_cur,
        covariance=covariance,
        valid=upstream.get("valid"),
        imu=batch.imu[:, -count:],
        imu_time_s=batch.imu_time_s[:, -count:],
        imu_mask=batch.imu_mask[:, -count:],
        duration_s=(elapsed_ns[:, -count:].double() * 1e-9).to(T_prev_cur.dtype),
        T_body_cam=batch.rig.T_body_cam,
        unstated=unstated,
    )


def make_pairs(
    *,
    T_prev_cur: Tensor,
    covariance: Tensor | None,
    valid: Tensor | None,
    imu: Tensor,
    imu_time_s: Tensor,
    imu_mask: Tensor,
    duration_s: Tensor,
    T_body_cam: Tensor,
    unstated: Unstated,
) -> Pairs:
    """Bring what the sensors said (shapes as in ``WindowBatch`` and ``VisualBatch``) into the axes of the body."""
    usable = T_prev_cur.isfinite().flatten(2).all(-1)
    visual = usable if valid is None else usable & valid
    R_body_cam = T_body_cam[:, None, :3, :3]
    R_cam_body = R_body_cam.transpose(-1, -2)
    identity = torch.eye(4, dtype=T_prev_cur.dtype, device=T_prev_cur.device)
    T_sound = torch.where(visual[..., None, None], T_prev_cur, identity)
    R_visual = product(product(R_body_cam, T_sound[..., :3, :3]), R_cam_body)
    t_camera = product(R_body_cam, T_sound[..., :3, 3:])[..., 0]
    log_variances = _log_variances(covariance, T_sound, R_body_cam, unstated) * visual[..., None]
    turn, push, longest = inertial_sums(imu, imu_time_s, imu_mask)
    inertial = (longest > 0.0) & (longest <= unstated.longest_gap_s)
    return Pairs(
        duration_s=duration_s,
        R_visual=R_visual,
        t_camera=t_camera,
        log_variances=log_variances,
        visual=visual,
        turn=turn * inertial[..., None],
        push=push * inertial[..., None],
        inertial=inertial,
        T_body_cam=T_body_cam,
    )


def _log_variances(covariance: Tensor | None, T_prev_cur: Tensor, R_body_cam: Tensor, unstated: Unstated) -> Tensor:
    distance = T_prev_cur[..., :3, 3].square().sum(-1)
    spread = unstated.translation_sigma**2 + unstated.translation_ratio**2 * distance
    assumed = torch.stack([torch.full_like(spread, unstated.rotation_sigma**2)] * 3 + [spread] * 3, dim=-1)
    if covariance is None:
        return assumed.log()
    R = R_body_cam.expand(*covariance.shape[:2], 3, 3)
    blocks = [covariance[..., :3, :3], covariance[..., 3:, 3:]]
    turned = [product(product(R, block), R.transpose(-1, -2)).diagonal(dim1=-2, dim2=-1) for block in blocks]
    variances = torch.cat(turned, dim=-1)
    stated = (variances > 0.0) & variances.isfinite()
    return torch.where(stated, variances, assumed).clamp_min(1e-16).log()


def integrated(imu: Tensor, time_s: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums over samples (B, S, K, 6), taken as linear in between, for each of the K − 1 steps.

    Rotations are added with the second-order term of Baker, Campbell and Hausdorff, which leaves a part of third order
    in the turn of a pair.

    Returns:
        rotation vector (B, S, K − 1, 3) since the first sample, what each step adds to the integral of the specific
        force (B, S, K − 1, 3) in the body at the first sample, and lengths of the steps (B, S, K − 1) s, zero where
        there is no sample.
    """
    steps = (time_s[..., 1:] - time_s[..., :-1]) * (mask[..., 1:] & mask[..., :-1])
    mean = 0.5 * (imu[..., 1:, :] + imu[..., :-1, :]) * steps[..., None]
    turns, pushes = mean[..., :3], mean[..., 3:]
    turned = (turns + 0.5 * torch.linalg.cross(turns.cumsum(-2) - turns, turns)).cumsum(-2)
    return turned, product(exp_so3(turned - 0.5 * turns), pushes[..., None])[..., 0], steps


def inertial_sums(imu: Tensor, time_s: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation vector (B, S, 3), integral of specific force (B, S, 3) and longest step (B, S) s of samples."""
    if imu.shape[2] < 2:
        nothing = imu.new_zeros(*imu.shape[:2], 3)
        return nothing, nothing.clone(), nothing[..., 0]
    turned, gains, steps = integrated(imu, time_s, mask)
    return turned[..., -1, :], gains.sum(-2), steps.max(-1).values


def disagreement(pairs: Pairs) -> Tensor:
    """``Log(R_gyroᵀ R_vo)`` (B, S, 3) rad: zero where one of the two is missing."""
    both = (pairs.visual & pairs.inertial)[..., None]
    R_gyro = exp_so3(pairs.turn)
    return log_so3(product(R_gyro.transpose(-1, -2), pairs.R_visual)) * both


def joined(parts: Sequence[Pairs]) -> Pairs:
    """Pairs of one rig put in a row."""
    merged = {
        each.name: torch.cat([getattr(part, each.name) for part in parts], dim=1)
        for each in fields(Pairs)
        if each.name != "T_body_cam"
    }
    return Pairs(**merged, T_body_cam=parts[0].T_body_cam)


def learn_interval(interval_s: Tensor, pairs: Pairs) -> None:
    """Keep, in place, the interval of images that a net first learns from, s."""
    if not bool(interval_s > 0.0):
        interval_s.copy_(pairs.duration_s.median())
