"""The real excerpts: sensors agree with the truth, in the axes, units and clocks that the readers say."""

import time
from pathlib import Path

import numpy as np
import pytest

from shared_data import shared_data
from vioframe.checks import Array
from vioframe.data import agreement
from vioframe.errors import DataError
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.types import Frame, ImuBlock, Trajectory
from vioframe_recordings import EurocDataset, KittiDataset, KittiRawDataset, TumviDataset
from vioframe_recordings.kitti_calibration import drive_date
from vioframe_recordings.kitti_level import check_level
from vioframe_recordings.stored import StoredRecording

EUROC = ["MH_01_easy", "MH_04_difficult", "V1_01_easy", "V1_02_medium", "V2_01_easy"]
KITTI = ["01", "02", "04", "06", "07", "08"]


def truth_of(recording: StoredRecording) -> Trajectory:
    truth = recording.ground_truth()
    assert truth is not None
    return truth


def gyro_agreement(imu: ImuBlock, truth: Trajectory) -> Array:
    return agreement.correlations(*agreement.rotation_rates(imu, truth))


@pytest.mark.parametrize("name", EUROC)
def test_euroc(name: str) -> None:
    root = shared_data("euroc_imu_gt", name).parent
    started = time.process_time()
    recording = EurocDataset(root=str(root), sequence=name, images=False).open(name)
    assert time.process_time() - started < 1.5
    truth = truth_of(recording)
    assert not [f for f in recording.findings() if f.level == "bad"]
    assert gyro_agreement(recording.imu, truth).min() > 0.997
    force, _ = agreement.mean_specific_force(recording.imu, truth)
    assert agreement.tilt_deg(force) < 2.0
    # Zurich has 9.807 m/s²; the rest is the bias of the accelerometer (about 0.05 to 0.15 along x and z).
    assert np.linalg.norm(force) == pytest.approx(9.807, abs=0.1)
    # Velocities of the truth are the derivatives of its positions.
    assert truth.v_world_body is not None
    elapsed = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
    difference = np.gradient(truth.T_world_body[:, :3, 3], elapsed, axis=0) - truth.v_world_body
    assert np.abs(difference).mean() < 0.05
    assert not recording.rig.has_images and len(recording.rig.cameras) == 1
    assert recording.frame_count > 1700


def test_euroc_corrected_truth_is_more_level() -> None:
    root = str(shared_data("euroc_imu_gt", "V1_01_easy").parent)
    tilts = []
    for choice in ("default", "corrected"):
        recording = EurocDataset(root=root, sequence="V1_01_easy", images=False, ground_truth=choice).open("V1_01_easy")
        tilts.append(agreement.tilt_deg(agreement.mean_specific_force(recording.imu, truth_of(recording))[0]))
    assert tilts[1] < 0.7 < 1.5 < tilts[0]


def test_euroc_stereo_clip() -> None:
    root = shared_data("euroc_V1_01_micro").parent
    recording = EurocDataset(root=str(root), sequence="euroc_V1_01_micro", cameras=2).open("euroc_V1_01_micro")
    frames = [p for p in recording.packets() if isinstance(p, Frame)]
    assert len(frames) == 20 and recording.counters() == {}
    assert all(image.shape == (480, 752) for frame in frames for image in frame.images)
    left, right = recording.rig.cameras
    T_left_right = np.linalg.inv(left.T_body_cam) @ right.T_body_cam
    assert T_left_right[0, 3] == pytest.approx(0.11, abs=0.001)
    # The published constants are those of the files.
    published = EurocDataset.profile.cameras
    for ours, theirs in zip(published, (left, right), strict=True):
        np.testing.assert_allclose(ours.T_body_cam, theirs.T_body_cam, atol=1e-12)
        np.testing.assert_array_equal(ours.intrinsics_px, theirs.intrinsics_px)
        np.testing.assert_array_equal(ours.distortion, theirs.distortion)


@pytest.mark.parametrize("name", ["dataset-room1_512_16", "dataset-room2_512_16"])
def test_tumvi_mocap_is_of_the_imu(name: str) -> None:
    root = shared_data("tumvi", name).parent
    recording = TumviDataset(root=str(root), sequence=name, images=False).open(name)
    truth = truth_of(recording)
    measured, true = agreement.rotation_rates(recording.imu, truth)
    # Axis by axis: a mocap body turned against the IMU would mix the axes. Mocap noise limits the rest.
    assert agreement.correlations(measured, true).min() > 0.98
    centred = true - true.mean(axis=0)
    assert (measured * centred).sum() / (centred**2).sum() == pytest.approx(1.0, abs=0.03)
    force, _ = agreement.mean_specific_force(recording.imu, truth)
    assert agreement.tilt_deg(force) < 1.0
    # Drop-outs are kept: nothing is put in their place.
    assert np.diff(truth.stamps_ns).max() > 500_000_000
    assert recording.rig.cameras[0].model == "equidistant"


def test_tumvi_published_cameras_are_a_stereo_pair() -> None:
    left, right = TumviDataset.profile.cameras
    T_left_right = np.linalg.inv(left.T_body_cam) @ right.T_body_cam
    # Schubert et al. 2018, section III: a baseline of about 10 cm along the images' x.
    assert T_left_right[0, 3] == pytest.approx(0.101, abs=0.002)
    assert np.degrees(np.arccos((np.trace(T_left_right[:3, :3]) - 1) / 2)) < 5.0


def kitti_root() -> Path:
    return shared_data("kitti", "imus_100hz_mat").parent


@pytest.mark.parametrize("name", KITTI)
def test_kitti(name: str) -> None:
    recording = KittiDataset(root=str(kitti_root()), sequence=name, images=False).open(name)
    truth = truth_of(recording)
    assert not [f for f in recording.findings() if f.level == "bad"]
    # Noise of the truth (0.1 s between poses) limits roll and pitch; yaw is what a car does.
    correlation = gyro_agreement(recording.imu, truth)
    assert correlation[2] > 0.99 and correlation.min() > 0.95
    # The two halves of the drive, averaged apart, agree on the vertical.
    finding = check_level(recording.imu, truth)
    assert finding.level == "good"
    tilts = [float(word.rstrip("°")) for word in finding.text.split() if word.endswith("°")]
    assert max(tilts) < 0.5
    assert np.linalg.norm(truth.T_world_body[0, :3, 3]) < 1e-9
    # Raw specific force, vehicle axes: gravity is on z.
    assert recording.imu.accel[:, 2].mean() == pytest.approx(9.81, abs=0.1)


@pytest.mark.parametrize("name", ["01", "06", "07"])
def test_kitti_samples_lag_by_the_default_delay(name: str) -> None:
    """With the delay the gyro follows the true yaw closely, without it by the turn rate times the delay."""
    residuals = []
    for delay_s in (0.0, 0.065, 0.13):
        recording = KittiDataset(root=str(kitti_root()), sequence=name, images=False, camera_delay_s=delay_s).open(name)
        measured, true = agreement.rotation_rates(recording.imu, truth_of(recording))
        residuals.append(float((measured - true)[5:-5, 2].std()))
    assert residuals[1] < 0.5 * min(residuals[0], residuals[2])


@pytest.mark.parametrize("name", KITTI)
def test_kitti_is_level_without_an_accelerometer(name: str) -> None:
    """The vehicle's own upright axis is within a few degrees of gravity; 04 is a short straight road."""
    ups = []
    for imu in ("required", "none"):
        dataset = KittiDataset(root=str(kitti_root()), sequence=name, images=False, camera_delay_s=0.0, imu=imu)
        ups.append(truth_of(dataset.open(name)).T_world_body[0, 2, :3])
    assert np.degrees(np.arccos(ups[0] @ ups[1])) < 3.0


def test_kitti_flat_town_is_flat() -> None:
    """Sequence 06 goes to and fro along one flat street of 450 m: a world off level by 0.5° would climb 4 m."""
    recording = KittiDataset(root=str(kitti_root()), sequence="06", images=False).open("06")
    position = truth_of(recording).T_world_body[:, :3, 3]
    assert np.ptp(position[:, :2], axis=0).max() > 400.0
    assert np.ptp(position[:, 2]) < 2.0


@pytest.mark.parametrize("name", ["01", "06", "07"])
def test_kitti_velocity_and_level_agree_with_the_accelerometer(name: str) -> None:
    """Over windows of one second, Δv of the truth is ∫(R a − g) dt of the accelerometer."""
    recording = KittiDataset(root=str(kitti_root()), sequence=name, images=False).open(name)
    truth, imu = truth_of(recording), recording.imu
    assert truth.v_world_body is not None
    T, covered = interpolate_poses(truth, imu.stamps_ns, max_gap_ns=200_000_000)
    acceleration = (T[covered, :3, :3] @ imu.accel[covered, :, None])[..., 0] - [0.0, 0.0, 9.81]
    seconds = (imu.stamps_ns[covered] - truth.stamps_ns[0]) / 1e9
    steps = 0.5 * (acceleration[1:] + acceleration[:-1]) * np.diff(seconds)[:, None]
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    at = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
    integral = np.stack([np.interp(at, seconds, total[:, axis]) for axis in range(3)], axis=1)
    error = (truth.v_world_body[10:] - truth.v_world_body[:-10]) - (integral[10:] - integral[:-10])
    assert np.sqrt((error[5:-5] ** 2).mean(axis=0)).max() < 0.1


@pytest.mark.parametrize("name", ["01", "06"])
def test_kitti_image_excerpts(name: str) -> None:
    recording = KittiDataset(root=str(kitti_root()), sequence=name).open(name)
    assert recording.frame_count == 51
    first = next(p for p in recording.packets() if isinstance(p, Frame))
    width, height = recording.rig.cameras[0].size_px
    assert first.images[0].shape == (height, width)
    truth = truth_of(recording)
    inside = truth.stamps_ns <= recording.frame_stamps_ns[-1] + recording.rig.camera_delay_ns
    path = np.linalg.norm(np.diff(truth.T_world_body[inside, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx({"01": 51.8, "06": 59.9}[name], abs=1.0)


def test_kitti_raw_excerpt_is_refused_unless_derived() -> None:
    root = str(shared_data("kitti_raw", "2011_09_26").parent)
    name = "2011_09_26_drive_0001_sync"
    with pytest.raises(DataError, match=r"no accelerometer .*dataset.missing_accel=derive"):
        KittiRawDataset(root=root, sequence=name).open(name)
    recording = KittiRawDataset(root=root, sequence=name, missing_accel="derive").open(name)
    assert recording.frame_count == 108
    assert [f.subject for f in recording.findings() if f.level == "bad"] == ["accelerometer"]
    truth = truth_of(recording)
    path = np.linalg.norm(np.diff(truth.T_world_body[:, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx(107.0, abs=0.5)
    # Velocity is in the vehicle in the file, along x; turned into the world it is the derivative of the position.
    assert truth.v_world_body is not None
    elapsed = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
    difference = np.gradient(truth.T_world_body[:, :3, 3], elapsed, axis=0) - truth.v_world_body
    assert np.abs(difference).mean() < 0.25
    # The calibration files of the day multiply out to the table of extrinsics.
    drive = drive_date("2011_09_26")
    assert drive is not None
    np.testing.assert_allclose(recording.rig.cameras[0].T_body_cam, drive.T_body_cam0, atol=1e-6)
    assert recording.rig.cameras[0].size_px == drive.size_px


def turned(imu: ImuBlock, *, gyro: list[int] | None = None, accel: list[int] | None = None) -> ImuBlock:
    """The samples with axes in another order; −1 turns an axis over, counted from 1."""

    def pick(values: Array, order: list[int] | None) -> Array:
        if order is None:
            return values
        return np.stack([np.sign(axis) * values[:, abs(axis) - 1] for axis in order], axis=1)

    return ImuBlock(stamps_ns=imu.stamps_ns, gyro=pick(imu.gyro, gyro), accel=pick(imu.accel, accel))


@pytest.mark.parametrize(
    ("accel", "said"), [([2, 1, 3], r"\(y, x, z\)"), ([2, 3, 1], r"\(z, x, y\)"), ([1, 2, -3], r"\(x, y, −z\)")]
)
@pytest.mark.parametrize("source", ["euroc", "tumvi", "kitti"])
def test_wrong_axes_are_found_and_named(source: str, accel: list[int], said: str) -> None:
    if source == "euroc":
        root = str(shared_data("euroc_imu_gt", "V1_02_medium").parent)
        recording = EurocDataset(root=root, sequence="V1_02_medium", images=False).open("V1_02_medium")
    elif source == "tumvi":
        root = str(shared_data("tumvi", "dataset-room2_512_16").parent)
        recording = TumviDataset(root=root, images=False).open("dataset-room2_512_16")
    else:
        recording = KittiDataset(root=str(kitti_root()), sequence="07", images=False).open("07")
    truth = truth_of(recording)
    agreement.check_with_truth(recording.imu, truth, "imu")
    with pytest.raises(DataError, match=f"accelerometer agrees .* only when its axes are taken as {said}"):
        agreement.check_with_truth(turned(recording.imu, accel=accel), truth, "imu")
    with pytest.raises(DataError, match=f"gyro agrees .* only when its axes are taken as {said}"):
        agreement.check_with_truth(turned(recording.imu, gyro=accel), truth, "imu")
