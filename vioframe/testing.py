"""Conformance checks for plugin authors: ``check_component(MyFuser())`` in the author's own tests.

The checks run the component on a small exact scene (a body that swings before a wall of dots) and hold it
to what the interfaces promise: shapes, frames, stamps, that ``setup`` forgets the last sequence, that inputs
are left alone, and that a blank image or a lost track is an honest answer instead of an exception.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Mask, check_pose
from vioframe.conventions import NANOSECONDS, gravity_vector
from vioframe.errors import VioframeError
from vioframe.geometry import camera as camera_model
from vioframe.geometry import se3, so3
from vioframe.interfaces import (
    CONSISTENT_SCALE,
    EMBEDDING,
    FLOW,
    METRIC_SCALE,
    RELATIVE_POSE,
    STEREO_TRACKS,
    TRACKS,
    Component,
    Frontend,
    Fuser,
    InertialIntegrator,
    Synchronizer,
    Trainable,
    UsesGroundTruth,
    VOEstimator,
)
from vioframe.pipeline import SLOTS
from vioframe.types import (
    Camera,
    Frame,
    Image,
    ImuBias,
    ImuBlock,
    ImuNoise,
    InertialDelta,
    Measurement,
    NavState,
    Packet,
    RelativePose,
    SensorRig,
    SyncedWindow,
    Tracks,
    Trajectory,
    VisualFeatures,
)

FRAME_STEP_NS = NANOSECONDS // 10
IMU_STEP_NS = NANOSECONDS // 200
FRAMES = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """A short exact recording and everything a component could be given of it.

    Attributes:
        rig: two cameras, an IMU of EuRoC's grade.
        truth: pose at every frame.
        frames: on the IMU clock.
        imu: of the whole scene, exact and without noise.
        windows: consecutive pairs of frames with their inertial samples.
        features: one for each frame, with the exact tracks of the dots.
    """

    rig: SensorRig
    truth: Trajectory
    frames: list[Frame]
    imu: ImuBlock
    windows: list[SyncedWindow]
    features: list[VisualFeatures]

    def packets(self) -> list[Packet]:
        """Inertial blocks and frames in the order of arrival."""
        packets: list[Packet] = []
        for window in self.windows:
            if not packets:
                packets += [self.imu.cut(0, 1), window.previous]
            chosen = (self.imu.stamps_ns > window.previous.stamp_ns) & (self.imu.stamps_ns <= window.current.stamp_ns)
            first, last = np.flatnonzero(chosen)[[0, -1]]
            packets += [self.imu.cut(int(first), int(last) + 1), window.current]
        return packets


def make_scene(seed: int = 0, embedding: int = 8) -> Scene:
    """Build the scene; the same seed gives the same arrays.

    Args:
        seed: of the dots.
        embedding: numbers of each frame's embedding, all zero.
    """
    random = np.random.default_rng(seed)
    rig = _rig()
    imu_stamps = np.arange(0, (FRAMES - 1) * FRAME_STEP_NS + 1, IMU_STEP_NS, dtype=np.int64)
    poses, velocities, gyro, accel = _motion(imu_stamps / NANOSECONDS, rig.gravity)
    imu = ImuBlock(stamps_ns=imu_stamps, gyro=gyro, accel=accel)
    every = FRAME_STEP_NS // IMU_STEP_NS
    truth = Trajectory(stamps_ns=imu_stamps[::every], T_world_body=poses[::every], v_world_body=velocities[::every])
    dots = random.uniform([3.0, -4.0, -3.0], [7.0, 4.0, 3.0], size=(220, 3))
    frames, features = [], []
    for stamp, T_world_body in zip(truth.stamps_ns, truth.T_world_body, strict=True):
        views = [_see(camera, T_world_body, dots) for camera in rig.cameras]
        images = tuple(
            _draw(camera, pixels[visible]) for camera, (pixels, visible) in zip(rig.cameras, views, strict=True)
        )
        frame = Frame(stamp_ns=int(stamp), images=images)
        pixels, visible = views[0]
        seen = pixels[visible]
        tracks = Tracks(
            ids=np.flatnonzero(visible).astype(np.int64),
            pixels=seen,
            bearings=camera_model.bearings(rig.cameras[0], seen),
            scores=np.ones(len(seen)),
        )
        frames.append(frame)
        features.append(
            VisualFeatures(frame=frame, tracks=tracks, flow=np.zeros((240, 320, 2)), embedding=np.zeros(embedding))
        )
    windows = [
        SyncedWindow(
            previous=frames[k],
            current=frames[k + 1],
            imu=imu.cut(k * every, (k + 1) * every + 1),
            gap_ns=IMU_STEP_NS,
        )
        for k in range(FRAMES - 1)
    ]
    return Scene(rig=rig, truth=truth, frames=frames, imu=imu, windows=windows, features=features)


def scene_for(component: Component) -> Scene:
    """The scene with embeddings as long as the component says, under ``embedding`` of its architecture, if it does."""
    length = component.architecture.get("embedding", 8) if isinstance(component, Trainable) else 8
    return make_scene(embedding=int(length))


def _rig() -> SensorRig:
    # The camera looks along the body's x axis: its z is body x, its x is body −y, its y is body −z.
    R_body_cam = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    cameras = tuple(
        Camera(
            model="pinhole",
            intrinsics_px=np.array([200.0, 200.0, 159.5, 119.5]),
            size_px=(320, 240),
            T_body_cam=se3.from_parts(R_body_cam, np.array([0.05, offset, 0.02])),
        )
        for offset in (0.06, -0.06)
    )
    noise = ImuNoise(gyro_noise=1.7e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0)
    return SensorRig(cameras=cameras, imu=noise)


def _motion(t: Array, gravity: float) -> tuple[Array, Array, Array, Array]:
    """Pose, velocity, gyro and specific force at times (N,) s, exact."""
    rates = np.array([1.0, 2.0, 1.5])
    sizes = np.array([0.5, 0.3, 0.2])
    phase = t[:, None] * rates
    position = sizes * np.sin(phase)
    velocity = sizes * rates * np.cos(phase)
    acceleration = -sizes * rates**2 * np.sin(phase)
    yaw, yaw_rate = 0.2 * np.sin(t), 0.2 * np.cos(t)
    R = so3.rotation_z(yaw)
    accel = (np.swapaxes(R, -1, -2) @ (acceleration - gravity_vector(gravity))[..., None])[..., 0]
    gyro = np.stack([np.zeros_like(t), np.zeros_like(t), yaw_rate], axis=-1)
    return se3.from_parts(R, position), velocity, gyro, accel


def _see(camera: Camera, T_world_body: Array, dots: Array) -> tuple[Array, Mask]:
    T_cam_world = se3.inverse(T_world_body @ camera.T_body_cam)
    return camera_model.project(camera, se3.transform(T_cam_world, dots))


def _draw(camera: Camera, pixels: Array) -> Image:
    """Bright Gaussian dots of 1.2 px on grey."""
    width, height = camera.size_px
    image = np.full((height, width), 60.0)
    reach = np.arange(-4, 5)
    for x, y in pixels:
        columns, rows = reach + round(x), reach + round(y)
        inside_x, inside_y = (columns >= 0) & (columns < width), (rows >= 0) & (rows < height)
        shape_x = np.exp(-0.5 * ((columns - x) / 1.2) ** 2)[inside_x]
        shape_y = np.exp(-0.5 * ((rows - y) / 1.2) ** 2)[inside_y]
        image[np.ix_(rows[inside_y], columns[inside_x])] += 150.0 * shape_y[:, None] * shape_x[None, :]
    drawn: Image = np.clip(image, 0, 255).astype(np.uint8)
    return drawn


def check_component(component: Component) -> None:
    """Hold one component to its interface.

    Args:
        component: built as a user would build it; not set up.

    Raises:
        AssertionError: the promise that is broken, in one sentence.
    """
    name = type(component).__name__
    kinds = [interface for interface in SLOTS.values() if isinstance(component, interface)]
    _expect(len(kinds) == 1, f"{name} must implement exactly one of the five interfaces, not {len(kinds)}")
    for what in ("requires", "provides"):
        names = getattr(component, what)
        _expect(
            isinstance(names, frozenset) and all(isinstance(each, str) for each in names),
            f"{name}.{what} must be a frozenset of strings, got {names!r}",
        )
    scene = scene_for(component)
    check = _CHECKS[kinds[0]]
    first = _run(component, scene, check)
    again = _run(component, scene, check)
    _expect(
        len(first) == len(again)
        and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, again, strict=True)),
        f"{name}.setup must forget the last sequence: the same recording gave another result the second time",
    )


def _run(component: Component, scene: Scene, check: Callable[[Component, Scene], list[Array]]) -> list[Array]:
    component.setup(scene.rig)
    if isinstance(component, UsesGroundTruth):
        component.take_ground_truth(scene.truth)
    before = [image.copy() for frame in scene.frames for image in frame.images]
    result = check(component, scene)
    after = [image for frame in scene.frames for image in frame.images]
    _expect(
        all(np.array_equal(a, b) for a, b in zip(before, after, strict=True)),
        f"{type(component).__name__} must leave the images it is given as they are",
    )
    return result


def _expect(holds: bool, message: str) -> None:
    if not holds:
        raise AssertionError(message)


def _check_synchronizer(component: Component, scene: Scene) -> list[Array]:
    if not isinstance(component, Synchronizer):
        raise AssertionError
    name = type(component).__name__
    windows = [window for packet in scene.packets() for window in component.push(packet)]
    windows += component.flush()
    _expect(len(windows) > 0, f"{name} made no window of {len(scene.frames)} frames with all their inertial samples")
    for before, after in itertools.pairwise(windows):
        _expect(
            before.current.stamp_ns <= after.previous.stamp_ns,
            f"{name} must give windows oldest first, each instant once",
        )
    return [np.concatenate([window.imu.gyro, window.imu.accel], axis=1) for window in windows]


def _check_frontend(component: Component, scene: Scene) -> list[Array]:
    if not isinstance(component, Frontend):
        raise AssertionError
    name = type(component).__name__
    results = []
    for frame in scene.frames:
        features = component.process(frame, np.eye(3))
        _expect(features.frame is frame, f"{name}.process must return the features of the frame it was given")
        for field in (TRACKS, FLOW, EMBEDDING):
            if field in component.provides:
                _expect(getattr(features, field) is not None, f"{name} provides {field}, but left it None")
        if STEREO_TRACKS in component.provides:
            _expect(features.stereo is not None, f"{name} provides {STEREO_TRACKS}, but left stereo None")
        if features.stereo is not None and features.tracks is not None:
            _expect(
                set(features.stereo.ids.tolist()) <= set(features.tracks.ids.tolist()),
                f"{name} gave a point of camera 1 an id that no point of camera 0 has",
            )
            _expect(features.stereo.camera == 1, f"{name} must say that its stereo tracks are of camera 1")
        extras = component.provides - {TRACKS, FLOW, EMBEDDING, STEREO_TRACKS}
        _expect(
            extras <= set(features.extras),
            f"{name} provides {sorted(extras)}, but extras has {sorted(features.extras)}",
        )
        if features.flow is not None:
            flow = features.flow
            _expect(flow.ndim == 3 and flow.shape[2] == 2, f"{name}.flow must be (H, W, 2), got {flow.shape}")
            _expect(bool(np.isfinite(flow).all()), f"{name}.flow must be finite")
            results.append(flow)
        if features.tracks is not None:
            ids = features.tracks.ids
            _expect(len(np.unique(ids)) == len(ids), f"{name} gave one id to two tracks of one frame")
            norms = np.linalg.norm(features.tracks.bearings, axis=1)
            _expect(bool(np.allclose(norms, 1.0, atol=1e-6)), f"{name} must give bearings of unit length")
            results.append(features.tracks.pixels)
    blank = Frame(
        stamp_ns=scene.frames[-1].stamp_ns + FRAME_STEP_NS,
        images=tuple(np.zeros_like(image) for image in scene.frames[-1].images),
    )
    component.process(blank, None)
    return results


def _check_vo(component: Component, scene: Scene) -> list[Array]:
    if not isinstance(component, VOEstimator):
        raise AssertionError
    name = type(component).__name__
    _expect(RELATIVE_POSE in component.provides, f"{name} must provide {RELATIVE_POSE}")
    results = []
    for previous, current in zip(scene.features, scene.features[1:], strict=False):
        relative = component.estimate(previous, current)
        _check_relative_pose(name, relative, component)
        results.append(relative.T_prev_cur)
    lost = VisualFeatures(
        frame=scene.frames[-1],
        tracks=Tracks(
            ids=np.zeros(0, dtype=np.int64), pixels=np.zeros((0, 2)), bearings=np.zeros((0, 3)), scores=np.zeros(0)
        ),
    )
    if TRACKS in component.requires:
        component.setup(scene.rig)
        relative = component.estimate(scene.features[0], lost)
        _expect(not relative.valid, f"{name} must say valid=False when every track is lost")
    return results


def _check_relative_pose(name: str, relative: RelativePose, component: VOEstimator) -> None:
    check_pose(f"{name}.estimate(...).T_prev_cur", relative.T_prev_cur)
    if not relative.valid:
        return
    if relative.covariance is not None:
        _check_covariance(f"{name}.estimate(...).covariance", relative.covariance)
    if not component.provides & {METRIC_SCALE, CONSISTENT_SCALE}:
        length = float(np.linalg.norm(relative.T_prev_cur[:3, 3]))
        _expect(
            abs(length - 1.0) < 1e-6,
            f"{name} provides no scale, so its translation must be of unit length, not {length:.3g}",
        )


def _check_integrator(component: Component, scene: Scene) -> list[Array]:
    if not isinstance(component, InertialIntegrator):
        raise AssertionError
    name = type(component).__name__
    results = []
    for window in scene.windows:
        delta = component.integrate(window.imu, ImuBias())
        elapsed = (window.current.stamp_ns - window.previous.stamp_ns) / NANOSECONDS
        _expect(
            abs(delta.duration_s - elapsed) < 1e-9, f"{name}: duration_s must be {elapsed} s, not {delta.duration_s}"
        )
        _check_covariance(f"{name}.integrate(...).covariance", delta.covariance)
        _expect(
            bool(np.allclose(delta.delta_R @ delta.delta_R.T, np.eye(3), atol=1e-9)),
            f"{name}: delta_R must be a rotation",
        )
        results.append(np.concatenate([delta.delta_R.ravel(), delta.delta_v, delta.delta_p]))
    repeated = component.integrate(scene.windows[0].imu, ImuBias())
    _expect(
        bool(np.array_equal(repeated.delta_p, results[0][12:])),
        f"{name} must keep no state: the same samples gave another increment the second time",
    )
    return results


def _check_fuser(component: Component, scene: Scene) -> list[Array]:
    if not isinstance(component, Fuser):
        raise AssertionError
    name = type(component).__name__
    try:
        component.start_from(
            NavState(
                stamp_ns=scene.frames[0].stamp_ns,
                T_world_body=scene.truth.T_world_body[0],
                v_world_body=np.asarray(scene.truth.v_world_body)[0],
            )
        )
    except VioframeError:
        pass  # a fuser may insist on initialising itself
    states: list[NavState] = []
    for index, window in enumerate(scene.windows):
        component.bias()
        states += component.update(measurement_of(scene, index, window))
    states += component.flush()
    stamps = [state.stamp_ns for state in states]
    _expect(stamps == sorted(set(stamps)), f"{name} must give states oldest first, each stamp once")
    for state in states:
        check_pose(f"{name}: NavState.T_world_body", state.T_world_body)
        if state.covariance is not None:
            _check_covariance(f"{name}: NavState.covariance", state.covariance)
    smoothed = component.smoothed()
    _expect(smoothed is None or not smoothed.causal, f"{name}.smoothed() must say causal=False")
    return [state.T_world_body for state in states]


def measurement_of(scene: Scene, index: int, window: SyncedWindow) -> Measurement:
    """The exact measurement of one window of the scene, with every field filled."""
    T_prev, T_cur = scene.truth.T_world_body[index], scene.truth.T_world_body[index + 1]
    T_body_cam = scene.rig.cameras[0].T_body_cam
    relative = RelativePose(
        T_prev_cur=se3.inverse(T_prev @ T_body_cam) @ T_cur @ T_body_cam,
        covariance=np.diag([1e-6] * 3 + [1e-5] * 3),
        inliers=100,
    )
    return Measurement(
        window=window,
        features=scene.features[index + 1],
        relative_pose=relative,
        inertial_delta=_exact_delta(scene, index),
    )


def _exact_delta(scene: Scene, index: int) -> InertialDelta:
    """The increment that the true states imply (Forster et al. 2017, eq. 33)."""
    T_prev, T_cur = scene.truth.T_world_body[index], scene.truth.T_world_body[index + 1]
    velocity = np.asarray(scene.truth.v_world_body)
    elapsed = FRAME_STEP_NS / NANOSECONDS
    g = gravity_vector(scene.rig.gravity)
    R_body_world = T_prev[:3, :3].T
    moved = T_cur[:3, 3] - T_prev[:3, 3] - velocity[index] * elapsed - 0.5 * g * elapsed**2
    bias_jacobian = np.zeros((9, 6))
    bias_jacobian[:3, :3] = -elapsed * np.eye(3)
    bias_jacobian[3:6, 3:] = -elapsed * np.eye(3)
    bias_jacobian[6:, 3:] = -0.5 * elapsed**2 * np.eye(3)
    return InertialDelta(
        delta_R=R_body_world @ T_cur[:3, :3],
        delta_v=R_body_world @ (velocity[index + 1] - velocity[index] - g * elapsed),
        delta_p=R_body_world @ moved,
        duration_s=elapsed,
        covariance=np.diag([1e-8] * 3 + [1e-6] * 3 + [1e-9] * 3),
        bias=ImuBias(),
        bias_jacobian=bias_jacobian,
    )


def _check_covariance(field: str, covariance: Array) -> None:
    _expect(bool(np.isfinite(covariance).all()), f"{field} must be finite")
    size = max(float(np.abs(covariance).max()), 1e-300)
    _expect(bool(np.allclose(covariance, covariance.T, atol=1e-9 * size)), f"{field} must be symmetric")
    smallest = float(np.linalg.eigvalsh(covariance).min())
    _expect(
        smallest > -1e-9 * size, f"{field} must be positive semi-definite, its smallest eigenvalue is {smallest:.3g}"
    )


_CHECKS: dict[type[Component], Callable[[Component, Scene], list[Array]]] = {
    Synchronizer: _check_synchronizer,
    Frontend: _check_frontend,
    VOEstimator: _check_vo,
    InertialIntegrator: _check_integrator,
    Fuser: _check_fuser,
}
