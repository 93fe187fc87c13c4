"""From a batch of windows and what a VO answered to what the filter makes of them."""

from collections.abc import Mapping

import torch
from torch import Tensor

from vioframe.fusion_options import InertialOptions, StartOptions, VisualOptions
from vioframe.learning.batch import WindowBatch
from vioframe.learning.motion import compose, covariance_from_log_variances, inverse, relative, vector_from_motion
from vioframe_ekf.net.increments import preintegrate
from vioframe_ekf.net.noise import FilterNoise
from vioframe_ekf.net.path import Holes, StartSigmas, follow, given_state, misplaced
from vioframe_ekf.net.robocentric import motion_noise


def run_filter(
    net: FilterNoise,
    batch: WindowBatch,
    upstream: Mapping[str, Tensor],
    *,
    visual: VisualOptions,
    gate: float,
    start: StartOptions,
    trust: InertialOptions,
    gravity_sigma: float,
    draw_start: bool,
    answered: int,
) -> dict[str, Tensor]:
    """What :meth:`vioframe_ekf.EkfVioFuser.forward_batch` returns.

    Args:
        net: what is learned.
        batch, upstream: as there.
        visual, trust, start: options of the fuser.
        gate: largest χ² of a motion that is used.
        gravity_sigma: m/s².
        draw_start: begin with states that are wrong by a draw from their covariance.
        answered: pairs at the end of each window whose motions are answers, at most all that the VO answered for.

    Returns:
        ``"T_prev_cur"`` of the camera for the answered pairs, and for all pairs that the VO answered for, in float64,
        ``"filter_poses"``, ``"filter_truth"`` (B, S' + 1, 4, 4) and ``"filter_covariances"`` (B, S', 6, 6).
    """
    measured = upstream["T_prev_cur"].double()
    pairs = measured.shape[1]
    valid, measured = _believable(measured, upstream)
    covariance = _stated(measured, upstream, visual)
    factors = net.visual_factors()
    covariance = factors[:, None] * covariance * factors
    T_body_cam = batch.rig.T_body_cam.double()[:, None]
    motion, noise = motion_noise(measured, T_body_cam, covariance)

    stamps_ns = batch.stamps_ns[:, -pairs - 1 :]
    duration_s = (stamps_ns[:, 1:] - stamps_ns[:, :-1]).double() * 1e-9
    v, gravity = (each[:, -pairs - 1].double() for each in (batch.velocity_body, batch.gravity_body))
    sigmas = StartSigmas(
        tilt=start.tilt_sigma,
        yaw=start.yaw_sigma,
        position=start.position_sigma,
        velocity=start.velocity_sigma,
        gravity=gravity_sigma,
        biases=net.bias_sigmas(),
    )
    first = given_state(v, gravity, sigmas)
    camera_truth = batch.T_prev_cur[:, -pairs:].double()
    body_truth = compose(T_body_cam @ camera_truth @ inverse(T_body_cam))
    T_first = torch.eye(4, dtype=first.R.dtype, device=first.R.device).repeat(len(v), 1, 1)
    T_first[:, :3, :3] = first.R
    truth = T_first[:, None] @ body_truth
    if draw_start:
        first = misplaced(first, torch.randn(len(v), 12, dtype=v.dtype, device=v.device))
    samples = preintegrate(batch.imu[:, -pairs:], batch.imu_time_s[:, -pairs:], batch.imu_mask[:, -pairs:])
    path = follow(
        first,
        samples,
        duration_s,
        net.densities(),
        Holes(allowed_s=trust.gap_allowed_s, rate_sigma=trust.gap_rate_sigma, accel_sigma=trust.gap_accel_sigma),
        motion,
        noise,
        valid,
        gate,
    )
    poses = path.poses()
    answers = relative((poses @ T_body_cam)[:, -min(answered, pairs) - 1 :])
    return {
        "T_prev_cur": answers.float(),
        "filter_poses": poses,
        "filter_truth": truth,
        "filter_covariances": path.pose_covariances(),
    }


def _believable(T_prev_cur: Tensor, upstream: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Which motions (B, S', 4, 4) are answers at all, and the motions with the identity for the others."""
    sound = T_prev_cur.isfinite().flatten(2).all(-1)
    if "valid" in upstream:
        sound = sound & upstream["valid"]
    eye = torch.eye(4, dtype=T_prev_cur.dtype, device=T_prev_cur.device)
    return sound, torch.where(sound[..., None, None], T_prev_cur, eye)


def _stated(T_prev_cur: Tensor, upstream: Mapping[str, Tensor], visual: VisualOptions) -> Tensor:
    """Covariances (B, S', 6, 6) of the motions: what the VO states, or what stands in for it."""
    if "log_variances" in upstream:
        vector = vector_from_motion(T_prev_cur)
        return visual.covariance_scale * covariance_from_log_variances(vector, upstream["log_variances"].double())
    distance = T_prev_cur[..., :3, 3].square().sum(-1)
    spread = visual.translation_sigma**2 + visual.translation_ratio**2 * distance
    turn = torch.full_like(spread, visual.rotation_sigma**2)
    stand_in = torch.stack([turn, spread], dim=-1).repeat_interleave(3, dim=-1).diag_embed()
    stated = upstream.get("covariance")
    if stated is not None:
        stated = stated.double()
        # Where none was stated there are zeros, and a motion that is no answer may have anything.
        there = stated.isfinite().flatten(2).all(-1) & (stated.diagonal(dim1=-2, dim2=-1).sum(-1) > 0.0)
        stand_in = torch.where(there[..., None, None], stated, stand_in)
    return visual.covariance_scale * stand_in
