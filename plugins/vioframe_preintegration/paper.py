"""The inertial equations exactly as EE-LCVIO prints them.

Zhao et al., "Loosely Coupled Visual-Inertial Odometry based on Spatial-Temporal Two-Stream Convolution
and Long Short-Term Memory Networks", Chinese Journal of Computers 45(8), 2022.
"""

import numpy as np

from vioframe.conventions import NANOSECONDS
from vioframe.errors import StateError
from vioframe.interfaces import InertialIntegrator
from vioframe.types import ImuBias, ImuBlock, ImuNoise, InertialDelta, InertialPath, SensorRig
from vioframe_preintegration.rotations import cumulative_products, exp_and_right_jacobian


class PaperIntegrator(InertialIntegrator):
    """The printed form: ``R ∏ Exp(ω Δt)``, ``Σ a Δt``, ``Σ (v Δt + ½ a Δt²)``.

    It is wrong, and is here so that the published method can be run as published and compared. The
    accelerations are added up without turning them by the attitude at their sample, so Δv and Δp mean
    something only while the body does not turn; no bias is subtracted, so what the fuser believes about
    the bias has no effect and the bias Jacobian is zero. Gravity is absent from the printed equations, and
    from every :class:`InertialDelta`: a fuser that adds it repairs that omission. Use
    ``integrator=preintegration`` for anything but this comparison.
    """

    def __init__(self) -> None:
        self._noise: ImuNoise | None = None

    def setup(self, rig: SensorRig) -> None:
        """Take the noise densities of the next sequence."""
        self._noise = rig.imu

    def integrate(self, imu: ImuBlock, bias: ImuBias) -> InertialDelta:
        """Add the samples up as printed; ``bias`` is not used."""
        noise = self._noise
        if noise is None:
            raise StateError("PaperIntegrator.integrate was called before setup(rig): set the integrator up first")
        elapsed = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
        steps = (elapsed[1:] - elapsed[:-1])[:, None]
        duration = float(elapsed[-1])
        turns, _ = exp_and_right_jacobian(imu.gyro[:-1] * steps)
        R = cumulative_products(turns)
        gains = imu.accel[:-1] * steps
        velocity = np.zeros_like(imu.accel)
        position = np.zeros_like(imu.accel)
        np.cumsum(gains, axis=0, out=velocity[1:])
        np.cumsum((velocity[:-1] + 0.5 * gains) * steps, axis=0, out=position[1:])
        # White noise through the printed sums; the error that the missing terms make is no noise and not in it.
        moments = np.array(
            [
                [noise.gyro_noise**2 * duration, 0.0, 0.0],
                [0.0, noise.accel_noise**2 * duration, noise.accel_noise**2 * duration**2 / 2],
                [0.0, noise.accel_noise**2 * duration**2 / 2, noise.accel_noise**2 * duration**3 / 3],
            ]
        )
        return InertialDelta(
            delta_R=R[-1],
            delta_v=velocity[-1],
            delta_p=position[-1],
            path=InertialPath(stamps_ns=imu.stamps_ns, delta_R=R, delta_v=velocity, delta_p=position),
            duration_s=duration,
            covariance=np.kron(moments, np.eye(3)),
            bias=ImuBias(),
            bias_jacobian=np.zeros((9, 6)),
        )
