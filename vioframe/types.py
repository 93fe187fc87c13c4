"""What flows between the parts: frozen values of numpy arrays, checked where they are made.

SI units unless a name says otherwise; frames and clocks as in :mod:`vioframe.conventions`. Ground truth
is not a field of any of these, so that no estimator can read it by accident.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vioframe import checks
from vioframe.checks import Array, Stamps, check_array, check_increasing, check_pose
from vioframe.errors import ShapeError
from vioframe.vision.keypoints import Keypoints

Image = checks.Image
Status = Literal["starting", "tracking", "lost"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """What the rig's cameras saw at one instant.

    Attributes:
        stamp_ns: camera clock until a synchronizer has seen it, IMU clock after.
        images: one (H, W) or (H, W, 3) uint8 RGB array per camera; empty where only stamps are known.
        missing: a synchronizer's stand-in for an image that did not come: there is a stamp, and nothing was seen.
    """

    stamp_ns: int
    images: tuple[Image, ...] = ()
    missing: bool = False

    def __post_init__(self) -> None:
        for index, image in enumerate(self.images):
            if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim not in (2, 3):
                raise ShapeError(
                    f"Frame.images[{index}] must be an (H, W) or (H, W, 3) uint8 array, got "
                    f"{getattr(image, 'shape', type(image).__name__)} {getattr(image, 'dtype', '')}"
                )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuBlock:
    """Inertial samples in a row.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing, IMU clock.
        gyro: (N, 3) rad/s, body.
        accel: (N, 3) m/s², body, specific force: reads +g upwards at rest.
    """

    stamps_ns: Stamps
    gyro: Array
    accel: Array

    def __post_init__(self) -> None:
        check_array("ImuBlock.stamps_ns", self.stamps_ns, (None,), np.integer)
        count = len(self.stamps_ns)
        check_array("ImuBlock.gyro", self.gyro, (count, 3))
        check_array("ImuBlock.accel", self.accel, (count, 3))
        check_increasing("ImuBlock.stamps_ns", self.stamps_ns)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def cut(self, start: int, end: int) -> "ImuBlock":
        """Samples [start, end)."""
        return ImuBlock(stamps_ns=self.stamps_ns[start:end], gyro=self.gyro[start:end], accel=self.accel[start:end])

    @staticmethod
    def none() -> "ImuBlock":
        """No samples at all."""
        return ImuBlock(stamps_ns=np.zeros(0, dtype=np.int64), gyro=np.zeros((0, 3)), accel=np.zeros((0, 3)))


Packet = Frame | ImuBlock
"""What a recording yields, in the order in which it arrives."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuBias:
    """What the sensor adds to the truth: gyro (3,) rad/s and accel (3,) m/s²."""

    gyro: Array = field(default_factory=lambda: np.zeros(3))
    accel: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        check_array("ImuBias.gyro", self.gyro, (3,))
        check_array("ImuBias.accel", self.accel, (3,))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuNoise:
    """Continuous noise densities of an inertial sensor.

    Attributes:
        gyro_noise: rad/s/√Hz.
        gyro_walk: rad/s²/√Hz, of the bias.
        accel_noise: m/s²/√Hz.
        accel_walk: m/s³/√Hz, of the bias.
        rate_hz: nominal sample rate.
    """

    gyro_noise: float
    gyro_walk: float
    accel_noise: float
    accel_walk: float
    rate_hz: float

    def __post_init__(self) -> None:
        for name in ("gyro_noise", "gyro_walk", "accel_noise", "accel_walk"):
            if not getattr(self, name) >= 0.0:
                raise ShapeError(f"ImuNoise.{name} must not be negative, got {getattr(self, name)}")
        if not self.rate_hz > 0.0:
            raise ShapeError(f"ImuNoise.rate_hz must be positive, got {self.rate_hz}")


CameraModel = Literal["pinhole", "radtan", "equidistant"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Camera:
    """Calibration of one camera; the projection itself is in :mod:`vioframe.geometry.camera`.

    Attributes:
        model: ``pinhole`` (no distortion), ``radtan`` (k1, k2, p1, p2[, k3], as OpenCV) or
            ``equidistant`` (k1…k4, Kannala–Brandt, as OpenCV's fisheye).
        intrinsics_px: (4,) fx, fy, cx, cy.
        distortion: (0,), (4,) or (5,).
        size_px: (width, height).
        T_body_cam: (4, 4).
    """

    model: CameraModel
    intrinsics_px: Array
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    size_px: tuple[int, int]
    T_body_cam: Array

    def __post_init__(self) -> None:
        counts = {"pinhole": (0,), "radtan": (4, 5), "equidistant": (4,)}
        if self.model not in counts:
            raise ShapeError(f"Camera.model must be one of {', '.join(counts)}, got {self.model!r}")
        check_array("Camera.intrinsics_px", self.intrinsics_px, (4,))
        check_array("Camera.distortion", self.distortion, (None,))
        if len(self.distortion) not in counts[self.model]:
            raise ShapeError(
                f"Camera.distortion of a {self.model} camera must have "
                f"{' or '.join(map(str, counts[self.model]))} values, got {len(self.distortion)}"
            )
        if min(self.intrinsics_px[:2]) <= 0.0:
            raise ShapeError(f"Camera.intrinsics_px must have positive fx, fy, got {self.intrinsics_px[:2]}")
        if min(self.size_px) <= 0:
            raise ShapeError(f"Camera.size_px must be positive (width, height), got {self.size_px}")
        check_array("Camera.T_body_cam", self.T_body_cam, (4, 4))
        check_pose("Camera.T_body_cam", self.T_body_cam, tolerance=1e-4)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensorRig:
    """The calibration a component is set up with.

    Attributes:
        cameras: in the order of ``Frame.images``; empty where a recording has none.
        has_images: False where the frames carry stamps only, though the cameras' calibration is known.
        imu: noise densities.
        gravity: magnitude, m/s².
        camera_delay_ns: ``t_imu = t_cam + camera_delay_ns``.
        has_imu: False where a recording has images alone: its frames are stamped by the camera's clock.
    """

    cameras: tuple[Camera, ...]
    imu: ImuNoise
    gravity: float = 9.81
    camera_delay_ns: int = 0
    has_images: bool = True
    has_imu: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SyncedWindow:
    """Two images and the inertial samples between them.

    Attributes:
        previous, current: frames on the IMU clock.
        imu: with samples exactly at both stamps; empty where there are none: the rig has no inertial sensor, or it
            fell silent and the synchronizer gives windows all the same.
        gap_ns: longest time without a measured sample inside the window.
        camera_delay_ns: what was added to the camera's stamp of ``current`` to bring it onto the IMU clock.
    """

    previous: Frame
    current: Frame
    imu: ImuBlock
    gap_ns: int
    camera_delay_ns: int = 0

    def __post_init__(self) -> None:
        if not len(self.imu):
            return
        if self.imu.stamps_ns[0] != self.previous.stamp_ns or self.imu.stamps_ns[-1] != self.current.stamp_ns:
            raise ShapeError(
                "SyncedWindow.imu must begin and end at the stamps of the frames, got "
                f"{self.imu.stamps_ns[0]}…{self.imu.stamps_ns[-1]} for {self.previous.stamp_ns}…{self.current.stamp_ns}"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """Points followed through one camera's images.

    Attributes:
        ids: (M,) int64; a point keeps its id as long as it is followed, and no id is used twice.
        pixels: (M, 2) px in the raw (distorted) image.
        bearings: (M, 3) unit vectors in the camera frame.
        scores: (M,) larger is better; meaning set by the front end.
        descriptors: (M, D) or None.
        camera: index into ``SensorRig.cameras``.
    """

    ids: Stamps
    pixels: Array
    bearings: Array
    scores: Array
    descriptors: np.ndarray | None = None
    camera: int = 0

    def __post_init__(self) -> None:
        check_array("Tracks.ids", self.ids, (None,), np.integer)
        count = len(self.ids)
        check_array("Tracks.pixels", self.pixels, (count, 2))
        check_array("Tracks.bearings", self.bearings, (count, 3))
        check_array("Tracks.scores", self.scores, (count,))

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def none(camera: int = 0) -> "Tracks":
        """No points at all."""
        return Tracks(
            ids=np.zeros(0, dtype=np.int64),
            pixels=np.zeros((0, 2)),
            bearings=np.zeros((0, 3)),
            scores=np.zeros(0),
            camera=camera,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VisualFeatures:
    """What a front end made of one frame.

    Attributes:
        frame: the frame itself.
        tracks: of camera 0, or None.
        stereo: the same points in camera 1 at the same instant, for those that were found there: its ids are
            among those of ``tracks``. None where the front end looks at one camera only.
        flow: (H, W, 2) px from the previous image to this one, or None.
        embedding: (D,) or None.
        untracked: described points of camera 0 that nobody follows, by which a place may be known again, or None.
        extras: fields a third party adds, by the name it puts in ``provides``.
    """

    frame: Frame
    tracks: Tracks | None = None
    stereo: Tracks | None = None
    flow: Array | None = None
    embedding: Array | None = None
    untracked: Keypoints | None = None
    extras: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativePose:
    """Motion of camera 0 between two images.

    Attributes:
        T_prev_cur: (4, 4). Translation in metres if the estimator provides ``metric_scale``; in one
            unknown unit, which may drift slowly, if ``consistent_scale``; else of unit length.
        covariance: (6, 6) or None; tangent (rotation, translation), right perturbation.
        valid: False where the estimator does not stand by the motion; the rest is then meaningless. What is not finite
            is no motion: such an answer becomes one that is not valid, as numbers of a net may do in mid-run.
        inliers: number of points that agree with it.
    """

    T_prev_cur: Array
    covariance: Array | None = None
    valid: bool = True
    inliers: int = 0

    def __post_init__(self) -> None:
        check_array("RelativePose.T_prev_cur", self.T_prev_cur, (4, 4), finite=False)
        if self.covariance is not None:
            check_array("RelativePose.covariance", self.covariance, (6, 6), finite=False)
        if not all(value is None or np.isfinite(value).all() for value in (self.T_prev_cur, self.covariance)):
            for name, value in {"T_prev_cur": np.eye(4), "covariance": None, "valid": False}.items():
                object.__setattr__(self, name, value)

    def in_body(self, rig: SensorRig, scale: float = 1.0) -> Array:
        """Motion of the body, (4, 4), with the translation multiplied by ``scale`` (metres per unit)."""
        T_body_cam = rig.cameras[0].T_body_cam
        T_prev_cur = self.T_prev_cur.copy()
        T_prev_cur[:3, 3] *= scale
        T_cam_body = np.eye(4)
        T_cam_body[:3, :3] = T_body_cam[:3, :3].T
        T_cam_body[:3, 3] = -T_body_cam[:3, :3].T @ T_body_cam[:3, 3]
        motion: Array = T_body_cam @ T_prev_cur @ T_cam_body
        return motion

    @staticmethod
    def invalid() -> "RelativePose":
        """The honest answer when no motion could be estimated."""
        return RelativePose(T_prev_cur=np.eye(4), valid=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InertialPath:
    """The increments from ``previous`` to every inner sample: what EE-LCVIO's sequential cache stacks.

    Attributes:
        stamps_ns: (N,), the first at ``previous``, the last at ``current``.
        delta_R: (N, 3, 3), the first the identity.
        delta_v: (N, 3) m/s and delta_p: (N, 3) m, in the body at ``previous``, gravity not applied.
    """

    stamps_ns: Stamps
    delta_R: Array
    delta_v: Array
    delta_p: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InertialDelta:
    """Preintegrated motion of the body from ``previous`` to ``current``.

    With T seconds between them and gravity g in the world:
    ``R_cur = R_prev ΔR``, ``v_cur = v_prev + g T + R_prev Δv``,
    ``p_cur = p_prev + v_prev T + ½ g T² + R_prev Δp`` (Forster et al. 2017, eq. 33).

    Attributes:
        delta_R: (3, 3); delta_v: (3,) m/s; delta_p: (3,) m; in the body at ``previous``, gravity not applied.
        path: the same at every inner sample, or None.
        duration_s: T.
        covariance: (9, 9), order (R, v, p), of the white noise; θ local: ``ΔR_true = ΔR Exp(θ)``.
        bias: what was subtracted from the samples.
        bias_jacobian: (9, 6), order (R, v, p) by (gyro, accel): change per change of the *subtracted* bias.
        reintegrate: the same samples with another bias, or None where the samples are gone.
        max_bias_change: (gyro rad/s, accel m/s²) up to which the first order is used.
    """

    delta_R: Array
    delta_v: Array
    delta_p: Array
    path: InertialPath | None = None
    duration_s: float
    covariance: Array
    bias: ImuBias
    bias_jacobian: Array
    reintegrate: Callable[[ImuBias], "InertialDelta"] | None = None
    max_bias_change: tuple[float, float] = (0.01, 0.1)

    def __post_init__(self) -> None:
        check_array("InertialDelta.delta_R", self.delta_R, (3, 3))
        check_array("InertialDelta.delta_v", self.delta_v, (3,))
        check_array("InertialDelta.delta_p", self.delta_p, (3,))
        check_array("InertialDelta.covariance", self.covariance, (9, 9))
        check_array("InertialDelta.bias_jacobian", self.bias_jacobian, (9, 6))

    def at(self, bias: ImuBias) -> "InertialDelta":
        """The increment with another bias: first order near, integrated again beyond ``max_bias_change``."""
        from dataclasses import replace

        from vioframe.geometry import so3

        gyro_change = bias.gyro - self.bias.gyro
        accel_change = bias.accel - self.bias.accel
        far = (
            np.linalg.norm(gyro_change) > self.max_bias_change[0]
            or np.linalg.norm(accel_change) > self.max_bias_change[1]
        )
        if far and self.reintegrate is not None:
            return self.reintegrate(bias)
        change = self.bias_jacobian @ np.concatenate([gyro_change, accel_change])
        return replace(
            self,
            delta_R=self.delta_R @ so3.exp(change[:3]),
            delta_v=self.delta_v + change[3:6],
            delta_p=self.delta_p + change[6:],
            path=None,
            bias=bias,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurement:
    """What a fuser sees for one window; an empty slot of the pipeline leaves None."""

    window: SyncedWindow
    features: VisualFeatures | None = None
    relative_pose: RelativePose | None = None
    inertial_delta: InertialDelta | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NavState:
    """The body at one instant.

    Attributes:
        stamp_ns: IMU clock.
        T_world_body: (4, 4).
        v_world_body: (3,) m/s, in the world.
        bias: estimated bias.
        covariance: (15, 15) or None, order (θ, p, v, b_g, b_a), θ local (``R_true = R Exp(θ)``), p and v in the world.
        status: ``starting`` until initialised, ``tracking``, or ``lost`` while the estimate is not supported.
    """

    stamp_ns: int
    T_world_body: Array
    v_world_body: Array = field(default_factory=lambda: np.zeros(3))
    bias: ImuBias = field(default_factory=ImuBias)
    covariance: Array | None = None
    status: Status = "tracking"

    def __post_init__(self) -> None:
        check_array("NavState.T_world_body", self.T_world_body, (4, 4))
        check_array("NavState.v_world_body", self.v_world_body, (3,))
        if self.covariance is not None:
            check_array("NavState.covariance", self.covariance, (15, 15))


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """One number that speaks for or against an initialisation.

    Attributes:
        value: in ``unit``.
        unit: for people, such as "deg" or "m/s²"; empty for a ratio or a count.
        limit: what the value is held against, or None where it only informs.
        good: whether it lies on the right side of the limit.
    """

    value: float
    unit: str = ""
    limit: float | None = None
    good: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InitialisationAttempt:
    """What an attempt to start found: the doctor's record.

    Attributes:
        stamp_ns: of the newest window it used, IMU clock.
        method: ``rest``, ``motion`` or ``given``.
        succeeded: whether the estimator started from it.
        fault: short name of what is missing, such as "no rotation"; empty when it succeeded.
        sentence: what, which value, what to do, for the log and the table.
        measures: every number by name.
    """

    stamp_ns: int
    method: str
    succeeded: bool
    fault: str = ""
    sentence: str = ""
    measures: Mapping[str, Measure] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses of the body over time.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing, IMU clock.
        T_world_body: (N, 4, 4).
        v_world_body: (N, 3) m/s or None.
        causal: False for a smoothed or loop-closed trajectory, which is never compared silently with a causal one.
    """

    stamps_ns: Stamps
    T_world_body: Array
    v_world_body: Array | None = None
    causal: bool = True

    def __post_init__(self) -> None:
        check_array("Trajectory.stamps_ns", self.stamps_ns, (None,), np.integer)
        count = len(self.stamps_ns)
        check_array("Trajectory.T_world_body", self.T_world_body, (count, 4, 4))
        check_pose("Trajectory.T_world_body", self.T_world_body, tolerance=1e-4)
        if self.v_world_body is not None:
            check_array("Trajectory.v_world_body", self.v_world_body, (count, 3))
        check_increasing("Trajectory.stamps_ns", self.stamps_ns)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @staticmethod
    def from_states(states: "list[NavState]", *, causal: bool = True) -> "Trajectory":
        """Stack states, oldest first."""
        return Trajectory(
            stamps_ns=np.array([s.stamp_ns for s in states], dtype=np.int64),
            T_world_body=np.array([s.T_world_body for s in states]).reshape(-1, 4, 4),
            v_world_body=np.array([s.v_world_body for s in states]).reshape(-1, 3),
            causal=causal,
        )
