"""Cameras of the simulated rigs: kits after well-known sensors, each number of which can be replaced."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array
from vioframe.errors import ConfigError, ShapeError
from vioframe.geometry import se3, so3
from vioframe.types import Camera

# Camera axes (right, down, forward) in a body that has x forward, y left, z up.
_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraKit:
    """Numbers of a known rig.

    Attributes:
        model, size_px, intrinsics_px, distortion: as in :class:`vioframe.types.Camera`.
        rate_hz: frames a second.
        baseline_m: to the second camera, along x of the first.
        lever_m: camera in the body.
        tilt: rotation vector, rad, by which the mounting is off the body's axes.
    """

    model: str
    size_px: tuple[int, int]
    intrinsics_px: tuple[float, ...]
    distortion: tuple[float, ...]
    rate_hz: float
    baseline_m: float
    lever_m: tuple[float, float, float]
    tilt: tuple[float, float, float]


KITS = {
    # Camera 0 of the EuRoC MAV rig (sensor.yaml of the data set); the mounting is ours, looking ahead.
    "euroc": CameraKit(
        model="radtan",
        size_px=(752, 480),
        intrinsics_px=(458.654, 457.296, 367.215, 248.375),
        distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
        rate_hz=20.0,
        baseline_m=0.11,
        lever_m=(0.065, 0.02, -0.01),
        tilt=(0.01, -0.015, 0.008),
    ),
    # Camera 0 of KITTI odometry 00 (calib.txt).
    "kitti": CameraKit(
        model="pinhole",
        size_px=(1241, 376),
        intrinsics_px=(718.856, 718.856, 607.1928, 185.2157),
        distortion=(),
        rate_hz=10.0,
        baseline_m=0.537,
        lever_m=(1.1, -0.32, 0.72),
        tilt=(0.001, 0.007, 0.009),
    ),
    # Camera 0 of TUM-VI at 512 px (camchain.yaml).
    "tumvi": CameraKit(
        model="equidistant",
        size_px=(512, 512),
        intrinsics_px=(190.97847715, 190.9733070, 254.93170605, 256.8974428),
        distortion=(0.0034823894, 0.00071503485, -0.0020532361, 0.00020293674),
        rate_hz=20.0,
        baseline_m=0.101,
        lever_m=(0.045, 0.05, -0.04),
        tilt=(0.01, -0.015, 0.008),
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraSettings:
    """The cameras; every number of ``conf/dataset/simulated.yaml`` under ``camera``. None takes the kit's value.

    Attributes:
        kit: ``euroc``, ``kitti``, ``tumvi``, or ``auto`` for the one that suits the motion.
        count: 1 or 2 cameras.
        rate_hz: frames a second.
        model: ``pinhole``, ``radtan`` or ``equidistant``.
        size_px: (width, height).
        intrinsics_px: fx, fy, cx, cy.
        distortion: coefficients of the model.
        baseline_m: from camera 0 to camera 1, along x of camera 0.
        T_body_cam: (4, 4) of camera 0, as rows.
        delay_s: ``t_imu = t_cam + delay``.
        rolling_shutter_s: from the exposure of the first row, which the stamp tells, to that of the last.
        images: False yields frames without pixels, in a hundredth of the time.
        noise_dn: standard deviation of the sensor's own noise, grey values of 255.
    """

    kit: str = "auto"
    count: int = 1
    rate_hz: float | None = None
    model: str | None = None
    size_px: Sequence[int] | None = None
    intrinsics_px: Sequence[float] | None = None
    distortion: Sequence[float] | None = None
    baseline_m: float | None = None
    T_body_cam: Sequence[Sequence[float]] | None = None
    delay_s: float = 0.0
    rolling_shutter_s: float = 0.0
    images: bool = True
    noise_dn: float = 1.0

    def __post_init__(self) -> None:
        if self.kit != "auto" and self.kit not in KITS:
            raise ConfigError(f"dataset.camera.kit must be auto, {', '.join(KITS)}, got {self.kit!r}")
        if self.count not in (1, 2):
            raise ConfigError(f"dataset.camera.count must be 1 or 2, got {self.count}")
        if self.rate_hz is not None and not self.rate_hz > 0.0:
            raise ConfigError(f"dataset.camera.rate_hz must be positive, got {self.rate_hz}")
        if self.baseline_m is not None and not self.baseline_m > 0.0:
            raise ConfigError(f"dataset.camera.baseline_m must be positive, got {self.baseline_m}")
        for name in ("rolling_shutter_s", "noise_dn"):
            if not getattr(self, name) >= 0.0:
                raise ConfigError(f"dataset.camera.{name} must not be negative, got {getattr(self, name)}")
        if not abs(self.delay_s) <= 1.0:
            raise ConfigError(f"dataset.camera.delay_s must be within a second, got {self.delay_s}")

    def frame_rate_hz(self, kit: str) -> float:
        """Frames a second, where ``kit`` stands in for ``auto``."""
        return self.rate_hz if self.rate_hz is not None else self._kit(kit).rate_hz

    def build(self, kit: str) -> tuple[Camera, ...]:
        """The cameras, where ``kit`` stands in for ``auto``.

        Raises:
            ConfigError: numbers that make no camera.
        """
        base = self._kit(kit)
        model = self.model if self.model is not None else base.model
        distortion = self.distortion
        if distortion is None:
            # Coefficients mean nothing to another model.
            distortion = base.distortion if model == base.model else (0.0,) * (0 if model == "pinhole" else 4)
        size = tuple(int(v) for v in (self.size_px if self.size_px is not None else base.size_px))
        if len(size) != 2:
            raise ConfigError(f"dataset.camera.size_px must be (width, height), got {size}")
        intrinsics = [float(v) for v in (self.intrinsics_px if self.intrinsics_px is not None else base.intrinsics_px)]
        if self.intrinsics_px is None and size != base.size_px:
            # The same field of view on another sensor; pixel centres are at whole numbers, hence the halves.
            ratio = np.array(size) / np.array(base.size_px)
            fx, fy, cx, cy = intrinsics
            intrinsics = [
                fx * ratio[0],
                fy * ratio[1],
                (cx + 0.5) * ratio[0] - 0.5,
                (cy + 0.5) * ratio[1] - 0.5,
            ]
        T_body_cam = self._mounting(base)
        shift = np.eye(4)
        cameras = []
        for index in range(self.count):
            shift[0, 3] = index * (self.baseline_m if self.baseline_m is not None else base.baseline_m)
            try:
                camera = Camera(
                    model=model,  # type: ignore[arg-type]  # Camera refuses any other name
                    intrinsics_px=np.array(intrinsics),
                    distortion=np.array([float(v) for v in distortion]),
                    size_px=size,
                    T_body_cam=T_body_cam @ shift,
                )
            except ShapeError as error:
                raise ConfigError(f"dataset.camera: {error}") from error
            cameras.append(camera)
        return tuple(cameras)

    def _kit(self, kit: str) -> CameraKit:
        return KITS[kit if self.kit == "auto" else self.kit]

    def _mounting(self, base: CameraKit) -> Array:
        if self.T_body_cam is None:
            return se3.from_parts(_FORWARD @ so3.exp(np.array(base.tilt)), np.array(base.lever_m))
        try:
            T_body_cam = np.array([[float(v) for v in row] for row in self.T_body_cam])
        except TypeError as error:
            raise ConfigError("dataset.camera.T_body_cam must be four rows of four numbers") from error
        if T_body_cam.shape != (4, 4):
            raise ConfigError(f"dataset.camera.T_body_cam must be four rows of four numbers, got {T_body_cam.shape}")
        return T_body_cam
