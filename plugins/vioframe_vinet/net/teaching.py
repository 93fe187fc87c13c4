"""What the fuser does with a batch of windows: answers, and how wrong they are."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from vioframe.learning.batch import WindowBatch
from vioframe.learning.motion import inverse, product
from vioframe_vinet.net.core import CoreAnswer
from vioframe_vinet.net.gyro import Sight
from vioframe_vinet.net.lasting import Lasting
from vioframe_vinet.net.loss import sight_loss
from vioframe_vinet.net.seeing import moved_to, seen_in_batch
from vioframe_vinet.options import Axes, NetOptions


def axes_of_answer(axes: Axes, T_body_cam: Tensor) -> Tensor:
    """T_axes_body (..., 4, 4): from the body to the axes in which the net answers."""
    if axes == "camera":
        return inverse(T_body_cam)
    return torch.eye(4, dtype=T_body_cam.dtype, device=T_body_cam.device).expand_as(T_body_cam)


def outputs_of_batch(net: nn.Module, options: NetOptions, batch: WindowBatch, embedding: Tensor) -> dict[str, Tensor]:
    """Motions of all pairs of each window, in the axes of the answer and of the camera, and what is stated of them.

    Args:
        net: as :func:`vioframe_vinet.net.assembly.make_net` makes it.
        options: of the net.
        batch: with inertial samples.
        embedding: (B, S, D).
    """
    axes = axes_of_answer(options.axes, batch.rig.T_body_cam)
    seen = seen_in_batch(
        batch,
        embedding,
        axes,
        intervals=options.imu_intervals,
        lost_images=options.lost_images if net.training else 0.0,
        lost_imu=options.lost_imu if net.training else 0.0,
    )
    answer: CoreAnswer
    answer, _ = net.get_submodule("core")(seen)
    into_camera = product(inverse(batch.rig.T_body_cam), inverse(axes))[:, None]
    named = {
        "vector": answer.vector,
        "motion": answer.T_prev_cur,
        "T_prev_cur": moved_to(into_camera, answer.T_prev_cur),
        "duration_s": seen.duration_s,
    }
    if answer.log_variances is not None:
        named["log_variances"] = answer.log_variances
    if answer.lasting is not None:
        named |= {"lasting_variance": answer.lasting.variance, "lasting_kept": answer.lasting.kept}
    if answer.sight is not None:
        named |= {"sight": answer.sight.vector, "sight_log_variances": answer.sight.log_variances}
        named["visible"] = seen.visible
    return named


def losses_of_batch(
    net: nn.Module, options: NetOptions, outputs: Mapping[str, Tensor], batch: WindowBatch
) -> dict[str, Tensor]:
    """``loss`` of what :func:`outputs_of_batch` returned, and what it is made of."""
    T_body_cam = batch.rig.T_body_cam
    axes = axes_of_answer(options.axes, T_body_cam)
    truth = moved_to(product(axes, T_body_cam)[:, None], batch.T_prev_cur)
    lasting = None
    if "lasting_variance" in outputs:
        lasting = Lasting(outputs["lasting_variance"], outputs["lasting_kept"])
    answer = CoreAnswer(outputs["motion"], outputs["vector"], outputs.get("log_variances"), lasting)
    losses: dict[str, Tensor] = net.get_submodule("weighing")(answer, truth, outputs["duration_s"])
    if "sight" in outputs:
        sight = Sight(outputs["sight"], outputs["sight_log_variances"])
        cost = sight_loss(sight, outputs["visible"], truth)
        losses |= {"loss": losses["loss"] + cost, "sight": cost.detach()}
    return losses
