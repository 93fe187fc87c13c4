"""One test for each sentence of vioframe/conventions.py, asked of the parts that have to obey it.

Where two parts of the project could disagree (simulator and integrator, camera model and image, covariance
and error), the test goes through both.
"""

import dataclasses

import numpy as np
import pytest

from inertial_truth import NOISE, QUIET, even_stamps, exact_increment, make_rig, motion, samples, window_of
from vioframe.conventions import GRAVITY, NANOSECONDS, STATE_ORDER, gravity_vector, seconds
from vioframe.errors import ShapeError
from vioframe.geometry import camera as camera_model
from vioframe.geometry import se3, so3
from vioframe.inertial import level
from vioframe.initialisation import measure_stillness, rest_state
from vioframe.types import (
    Camera,
    Frame,
    ImuBias,
    ImuBlock,
    InertialDelta,
    Measurement,
    NavState,
    RelativePose,
    SensorRig,
    SyncedWindow,
    Trajectory,
)

CAMERA = Camera(
    model="pinhole", intrinsics_px=np.array([100.0, 100.0, 32.0, 24.0]), size_px=(65, 49), T_body_cam=np.eye(4)
)


def integrator():
    from vioframe_preintegration import Preintegration

    made = Preintegration()
    made.setup(make_rig())
    return made


def constant(gyro: list[float], accel: list[float], seconds_: float = 1.0) -> ImuBlock:
    stamps = even_stamps(0.0, seconds_, round(200 * seconds_))
    ones = np.ones((len(stamps), 1))
    return ImuBlock(stamps_ns=stamps, gyro=ones * gyro, accel=ones * accel)


# --- Frames ---


def test_convention_the_body_frame_is_the_imu_frame() -> None:
    """No extrinsics stand between samples and body: a rate about the sensor's x turns the body about its x."""
    assert not any("T_" in field.name for field in dataclasses.fields(SensorRig))
    delta = integrator().integrate(constant([0.5, 0.0, 0.0], [0.0, 0.0, 0.0]), ImuBias())
    np.testing.assert_allclose(so3.log(delta.delta_R), [0.5, 0.0, 0.0], atol=1e-12)


def test_convention_the_world_has_z_up() -> None:
    """What rises at rest reads a larger specific force, and gains z."""
    up = constant([0, 0, 0], [0.0, 0.0, GRAVITY + 1.0])
    delta = integrator().integrate(up, ImuBias())
    g = gravity_vector()
    position = 0.5 * g + delta.delta_p
    np.testing.assert_allclose(position, [0, 0, 0.5], atol=1e-9)


def test_convention_gravity_is_minus_g_along_z() -> None:
    np.testing.assert_array_equal(gravity_vector(9.5), [0.0, 0.0, -9.5])


def test_convention_the_camera_looks_along_z() -> None:
    pixel, visible = camera_model.project(CAMERA, np.array([0.0, 0.0, 3.0]))
    assert visible
    np.testing.assert_allclose(pixel, CAMERA.intrinsics_px[2:])
    assert not camera_model.project(CAMERA, np.array([0.0, 0.0, -3.0]))[1]


def test_convention_camera_x_is_right_and_y_is_down() -> None:
    """In the picture as it is stored: columns grow to the right, rows downwards."""
    pixel, _ = camera_model.project(CAMERA, np.array([0.3, -0.2, 3.0]))
    assert pixel[0] > CAMERA.intrinsics_px[2] and pixel[1] < CAMERA.intrinsics_px[3]


def test_convention_T_a_b_maps_coordinates_of_b_into_a() -> None:
    T_a_b = se3.from_parts(so3.rotation_z(np.pi / 2), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(se3.transform(T_a_b, np.array([[1.0, 0.0, 0.0]])), [[1.0, 3.0, 3.0]], atol=1e-12)
    # The origin of b, seen from a, is the translation.
    np.testing.assert_allclose(se3.transform(T_a_b, np.zeros((1, 3)))[0], T_a_b[:3, 3])


def test_convention_inner_names_touch() -> None:
    """T_world_cam = T_world_body T_body_cam, in the type that uses it most: the motion of camera and of body."""
    T_body_cam = se3.exp(np.array([0.3, -1.0, 0.5, 0.2, 0.1, -0.3]))
    rig = SensorRig(cameras=(dataclasses.replace(CAMERA, T_body_cam=T_body_cam),), imu=NOISE)
    T_world_prev, T_world_cur = motion(np.array([0.0, 0.4])).T_world_body
    camera_motion = se3.inverse(T_world_prev @ T_body_cam) @ (T_world_cur @ T_body_cam)
    body_motion = RelativePose(T_prev_cur=camera_motion).in_body(rig)
    np.testing.assert_allclose(T_world_prev @ body_motion, T_world_cur, atol=1e-12)


# --- Pixels ---


def test_convention_pixel_x_is_right_and_y_is_down() -> None:
    """A mark painted at image[row, column] has the bearing of the pixel (column, row)."""
    image = np.zeros((49, 65))
    image[10, 50] = 1.0
    rows, columns = np.indices(image.shape)
    centroid = np.array([np.sum(columns * image), np.sum(rows * image)])
    point = 4.0 * camera_model.bearings(CAMERA, centroid)
    assert point[0] > 0.0 and point[1] < 0.0
    np.testing.assert_allclose(camera_model.project(CAMERA, point)[0], [50.0, 10.0])


def test_convention_the_centre_of_the_top_left_pixel_is_the_origin() -> None:
    """So the image reaches from −0.5 to width − 0.5."""
    corner = camera_model.bearings(CAMERA, np.array([0.0, 0.0]))
    assert camera_model.project(CAMERA, corner)[1]
    for border, inside in ((-0.49, True), (-0.51, False), (64.49, True), (64.51, False)):
        ray = camera_model.bearings(CAMERA, np.array([border, 20.0]))
        assert bool(camera_model.project(CAMERA, ray)[1]) is inside


def test_convention_opencv_paints_where_the_camera_model_says() -> None:
    """A white square painted by OpenCV, whose pixel centres are whole numbers, is centred on its projection."""
    cv2 = pytest.importorskip("cv2")
    corners = np.array([[-0.3, -0.2, 4.0], [0.5, -0.2, 4.0], [0.5, 0.4, 4.0], [-0.3, 0.4, 4.0]])
    pixels, _ = camera_model.project(CAMERA, corners)
    image = np.zeros((49, 65), dtype=np.uint8)
    shift = 6
    cv2.fillConvexPoly(image, np.round(pixels * 2**shift).astype(np.int32), 255, lineType=cv2.LINE_AA, shift=shift)
    rows, columns = np.indices(image.shape)
    centroid = np.array([np.sum(columns * image), np.sum(rows * image)]) / image.sum()
    np.testing.assert_allclose(centroid, pixels.mean(axis=0), atol=0.05)


# --- Clocks ---


def test_convention_stamps_are_integer_nanoseconds() -> None:
    assert NANOSECONDS == 10**9
    with pytest.raises(ShapeError, match="integer"):
        ImuBlock(stamps_ns=np.array([0.0, 0.005]), gyro=np.zeros((2, 3)), accel=np.zeros((2, 3)))
    with pytest.raises(ShapeError, match="integer"):
        Trajectory(stamps_ns=np.array([0.0]), T_world_body=np.eye(4)[None])
    # A difference keeps every nanosecond although the stamps themselves do not fit a double.
    late = 1_403_715_273_262_142_977
    assert seconds(late - (late - 1)) == 1e-9


def test_convention_the_synchronizer_moves_frames_to_the_imu_clock() -> None:
    """t_imu = t_cam + camera_delay: a camera whose clock is behind has a positive delay."""
    from vioframe_sync import InterpolateSynchronizer

    delay = 12_000_000
    synchronizer = InterpolateSynchronizer()
    synchronizer.setup(make_rig(camera_delay_ns=delay))
    stamps = even_stamps(0.0, 1.0, 200)
    windows = synchronizer.push(samples(stamps))
    for stamp in (100_000_000, 150_000_000):
        windows += synchronizer.push(Frame(stamp_ns=stamp))
    (window,) = windows
    assert (window.previous.stamp_ns, window.current.stamp_ns) == (100_000_000 + delay, 150_000_000 + delay)
    # And the samples are those of that instant.
    np.testing.assert_allclose(window.imu.gyro[0], motion(np.array([0.112])).gyro[0], atol=1e-3)


# --- Inertial samples ---


@pytest.mark.parametrize("attitude", [[0, 0, 0], [np.pi, 0, 0], [0.4, -1.1, 2.0]])
def test_convention_the_accelerometer_reads_g_upwards_at_rest(attitude: list[float]) -> None:
    """In the test motion, in the simulator, in levelling and in the integrator alike."""
    R_world_body = so3.exp(np.array(attitude, dtype=float))
    reading = R_world_body.T @ [0.0, 0.0, GRAVITY]
    np.testing.assert_allclose(level(reading)[2], R_world_body[2], atol=1e-12)
    delta = integrator().integrate(constant([0, 0, 0], list(reading)), ImuBias())
    np.testing.assert_allclose(gravity_vector() + R_world_body @ delta.delta_v, 0.0, atol=1e-9)


def test_convention_the_simulator_reads_g_upwards_at_rest() -> None:
    from vioframe.data.simulator import SimulatedDataset

    dataset = SimulatedDataset(sequence="standing", duration_s=2.0)
    recording = dataset.open(dataset.sequences[0])
    truth = recording.ground_truth()
    assert truth is not None
    imu = recording.exact_imu(truth.stamps_ns[:1])
    np.testing.assert_allclose(truth.T_world_body[0, :3, :3] @ imu.accel[0], [0, 0, recording.rig.gravity], atol=0.05)


def test_convention_rates_are_of_the_body_in_body_axes() -> None:
    """A body that lies on its side and is turned about the world's vertical feels the rate about its own y."""
    R_world_body = so3.exp(np.array([np.pi / 2, 0.0, 0.0]))
    gyro = R_world_body.T @ [0.0, 0.0, 0.3]
    np.testing.assert_allclose(gyro, [0.0, 0.3, 0.0], atol=1e-12)
    delta = integrator().integrate(constant(list(gyro), [0, 0, 0]), ImuBias())
    np.testing.assert_allclose(R_world_body @ delta.delta_R, so3.rotation_z(0.3) @ R_world_body, atol=1e-9)


def test_convention_simulated_rates_turn_the_simulated_body() -> None:
    from vioframe.data.simulator import SimulatedDataset

    dataset = SimulatedDataset(sequence="drone", duration_s=6.0)
    recording = dataset.open(dataset.sequences[0])
    truth = recording.ground_truth()
    assert truth is not None and truth.v_world_body is not None
    first, last = len(truth) // 2, len(truth) // 2 + 10
    stamps = np.linspace(truth.stamps_ns[first], truth.stamps_ns[last], 2001).round().astype(np.int64)
    delta = integrator().integrate(recording.exact_imu(stamps), ImuBias())
    T = seconds(int(stamps[-1] - stamps[0]))
    R = truth.T_world_body[first, :3, :3]
    g = gravity_vector(recording.rig.gravity)
    assert so3.angle((R @ delta.delta_R).T @ truth.T_world_body[last, :3, :3]) < 1e-5
    v = truth.v_world_body[first] + g * T + R @ delta.delta_v
    np.testing.assert_allclose(v, truth.v_world_body[last], atol=1e-4)
    p = truth.T_world_body[first, :3, 3] + truth.v_world_body[first] * T + 0.5 * g * T**2 + R @ delta.delta_p
    np.testing.assert_allclose(p, truth.T_world_body[last, :3, 3], atol=1e-4)


def test_convention_a_sample_is_the_value_at_its_stamp() -> None:
    """Not the mean over the interval before or after: a rate that grows linearly is integrated exactly."""
    stamps = even_stamps(0.0, 1.0, 10)
    t = stamps / NANOSECONDS
    gyro = np.stack([0 * t, 0 * t, t], axis=1)
    delta = integrator().integrate(ImuBlock(stamps_ns=stamps, gyro=gyro, accel=0 * gyro), ImuBias())
    np.testing.assert_allclose(so3.log(delta.delta_R), [0, 0, 0.5], atol=1e-12)
    # A synchronizer finds the value between two stamps on the line between them.
    from vioframe_sync import InterpolateSynchronizer

    synchronizer = InterpolateSynchronizer()
    synchronizer.setup(make_rig())
    imu = ImuBlock(stamps_ns=stamps, gyro=gyro, accel=0 * gyro)
    (window,) = [
        window
        for packet in (imu, Frame(stamp_ns=230_000_000), Frame(stamp_ns=570_000_000))
        for window in synchronizer.push(packet)
    ]
    np.testing.assert_allclose(window.imu.gyro[[0, -1], 2], [0.23, 0.57], atol=1e-12)


# --- Uncertainty ---


def test_convention_tangents_are_rotation_then_translation() -> None:
    T = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 5.0, 0.0]))
    assert so3.angle(T[:3, :3]) == pytest.approx(0.1)
    assert np.linalg.norm(T[:3, 3]) == pytest.approx(5.0, rel=0.01)
    np.testing.assert_allclose(se3.log(T), [0.1, 0.0, 0.0, 0.0, 5.0, 0.0], atol=1e-12)


def test_convention_the_covariance_of_a_motion_is_rotation_then_translation() -> None:
    """A fuser told of a motion with uncertain rotation alone is unsure of its attitude alone."""
    from vioframe_reckoning import VoOnlyFuser

    rig = SensorRig(cameras=(CAMERA,), imu=NOISE)
    fuser = VoOnlyFuser()
    fuser.setup(rig)
    fuser.start_from(NavState(stamp_ns=0, T_world_body=np.eye(4), covariance=1e-12 * np.eye(15)))
    pose = RelativePose(T_prev_cur=np.eye(4), covariance=np.diag([0.04, 0.04, 0.04, 1e-6, 1e-6, 1e-6]))
    window = window_of(samples(even_stamps(0.0, 0.1, 20)))
    last = fuser.update(Measurement(window=window, relative_pose=pose))[-1]
    assert last.covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(last.covariance)[:6]), [0.2] * 3 + [1e-3] * 3, rtol=1e-3)


def test_convention_errors_are_local_on_the_right() -> None:
    """R_true = R_estimated Exp(θ): a level body that does not know its heading is unsure about its own vertical.

    Standing on its x axis, that is body x; a world-side error would be unsure about z whatever the attitude.
    """
    R_world_body = so3.from_two_vectors(np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))
    still = constant([0, 0, 0], list(R_world_body.T @ [0, 0, GRAVITY]))
    state = rest_state(0, measure_stillness(still), NOISE, GRAVITY, yaw_sigma=0.5, accel_bias_sigma=1e-3)
    assert state.covariance is not None
    sigmas = np.sqrt(np.diag(state.covariance)[:3])
    assert sigmas[0] == pytest.approx(0.5, rel=1e-3) and np.all(sigmas[1:] < 1e-3)


def test_convention_state_covariance_is_theta_p_v_and_the_biases() -> None:
    assert STATE_ORDER == ("theta", "p", "v", "bias_gyro", "bias_accel")
    still = constant([0, 0, 0], [0, 0, GRAVITY])
    state = rest_state(
        0, measure_stillness(still), NOISE, GRAVITY, position_sigma=2.0, velocity_sigma=3.0, accel_bias_sigma=4.0
    )
    assert state.covariance is not None
    sigmas = np.sqrt(np.diag(state.covariance))
    np.testing.assert_allclose(sigmas[3:9], [2.0] * 3 + [3.0] * 3)
    assert np.all(sigmas[9:12] < 1e-3)
    np.testing.assert_allclose(sigmas[12:14], 4.0)


def test_convention_p_and_v_of_a_state_are_in_the_world() -> None:
    """A body on its side, pushed along its own y for a second with an uncertain bias there, is unsure of its height."""
    from vioframe_reckoning import ImuOnlyFuser

    R_world_body = so3.exp(np.array([np.pi / 2, 0.0, 0.0]))
    fuser = ImuOnlyFuser()
    fuser.setup(make_rig(QUIET))
    covariance = 1e-12 * np.eye(15)
    covariance[13, 13] = 0.01
    fuser.start_from(
        NavState(stamp_ns=0, T_world_body=se3.from_parts(R_world_body, np.zeros(3)), covariance=covariance)
    )
    imu = constant([0, 0, 0], list(R_world_body.T @ [0, 0, GRAVITY]))
    delta = integrator().integrate(imu, ImuBias())
    last = fuser.update(Measurement(window=window_of(imu), inertial_delta=delta))[-1]
    assert last.covariance is not None
    sigma_v = np.sqrt(np.diag(last.covariance)[6:9])
    assert sigma_v[2] == pytest.approx(0.1, rel=0.05) and np.all(sigma_v[:2] < 0.02)


def test_convention_a_preintegrated_covariance_is_R_v_p() -> None:
    delta = integrator().integrate(constant([0, 0, 0], [0, 0, 0], 4.0), ImuBias())
    expected = [NOISE.gyro_noise * 2.0, NOISE.accel_noise * 2.0, NOISE.accel_noise * np.sqrt(64 / 3)]
    np.testing.assert_allclose(np.sqrt(np.diag(delta.covariance)), np.repeat(expected, 3), rtol=1e-6)


def test_convention_preintegrated_v_and_p_are_in_the_first_body_frame() -> None:
    """Gravity not applied: they give the true states by the equation of InertialDelta's docstring."""
    stamps = even_stamps(0.3, 0.8, 2000)
    delta = integrator().integrate(samples(stamps), ImuBias())
    R, v, p = exact_increment(0.3, 0.8)
    assert isinstance(delta, InertialDelta)
    np.testing.assert_allclose(delta.delta_R, R, atol=1e-6)
    np.testing.assert_allclose(delta.delta_v, v, atol=1e-5)
    np.testing.assert_allclose(delta.delta_p, p, atol=1e-5)


def test_convention_a_window_begins_and_ends_with_a_sample() -> None:
    imu = samples(even_stamps(0.0, 0.1, 20))
    with pytest.raises(ShapeError, match="begin and end"):
        SyncedWindow(previous=Frame(stamp_ns=0), current=Frame(stamp_ns=99_000_000), imu=imu, gap_ns=0)
