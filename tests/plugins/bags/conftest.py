"""What the bags of these tests are written from."""

from types import SimpleNamespace

import pytest

from vioframe.data.simulator import CameraSettings, ImuSettings, SimulatedDataset

DELAY_S = 0.004


@pytest.fixture(scope="session")
def simulated():
    """A second of stereo, with a camera clock that is off."""
    dataset = SimulatedDataset(
        duration_s=1.0,
        standstill_s=0.0,
        camera=CameraSettings(
            count=2, size_px=[160, 120], rate_hz=10.0, delay_s=DELAY_S, model="equidistant", T_body_cam=None
        ),
        imu=ImuSettings(rate_hz=100.0),
    )
    recording = dataset.open(dataset.sequences[0])
    return SimpleNamespace(
        rig=recording.rig, packets=list(recording.packets()), truth=recording.ground_truth(), name=recording.name
    )


@pytest.fixture
def options(tmp_path, simulated):
    from bag_writing import write_calibration

    return write_calibration(tmp_path / "calibration", simulated.rig)
