"""The built-in simulated recording: exact motion, IMU and rendered images."""

from vioframe.data.simulator.cameras import CameraSettings
from vioframe.data.simulator.dataset import SimulatedDataset
from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.imu import ImuSettings
from vioframe.data.simulator.recording import SimulatedRecording
from vioframe.data.simulator.replay import ReplayDataset, ReplayRecording

__all__ = [
    "CameraSettings",
    "Degradations",
    "ImuSettings",
    "ReplayDataset",
    "ReplayRecording",
    "SimulatedDataset",
    "SimulatedRecording",
]
