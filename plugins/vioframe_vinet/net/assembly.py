"""The net that one set of options describes."""

from torch import nn

from vioframe_vinet.net.core import VinetCore
from vioframe_vinet.net.loss import AccumulatedLikelihood, PoseErrors
from vioframe_vinet.options import NetOptions


def make_net(options: NetOptions) -> nn.Module:
    """``core`` and ``weighing``, its loss, with random weights."""
    core = VinetCore(
        embedding=options.embedding,
        imu_intervals=options.imu_intervals,
        imu_hidden=options.imu_hidden,
        imu_layers=options.imu_layers,
        hidden=options.hidden,
        layers=options.layers,
        joined=options.joined,
        dropout=options.dropout,
        log_variances=options.log_variances,
        gyro_turns=options.rotation == "gyro",
        gyro_bias_sigma=options.gyro_bias_sigma,
        gyro_memory=options.gyro_memory,
        scale_memory=options.scale_memory,
        feed_back_pose=options.feedback == "pose",
        rotation_unit_rad=options.rotation_unit_rad,
        translation_unit_m=options.translation_unit_m,
    )
    means = PoseErrors(
        log_variance_rotation=options.log_variance_rotation,
        log_variance_translation=options.log_variance_translation,
        window=options.window,
        pose_weight=options.pose_weight,
    )
    weighing: nn.Module = means
    if options.loss == "likelihood":
        weighing = AccumulatedLikelihood(means, horizons=options.horizons, scale_memory=options.scale_memory)
    return nn.ModuleDict({"core": core, "weighing": weighing})
