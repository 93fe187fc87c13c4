"""Whole pipelines whose camera or inertial sensor falls silent, in mid-run or before the start."""

import numpy as np
import pytest

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.data.faults import Faults
from vioframe.data.simulated_vo import SimulatedVO
from vioframe.data.simulator import CameraSettings, SimulatedDataset
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.interfaces import Fuser
from vioframe.pipeline import Pipeline
from vioframe.tasks.run_sequence import initial_state
from vioframe.types import NavState
from vioframe_ekf import EkfFuser
from vioframe_msf import MsfFuser
from vioframe_preintegration import Preintegration
from vioframe_reckoning import ImuOnlyFuser, VoOnlyFuser
from vioframe_sync import SequentialCacheSynchronizer

DATASET = SimulatedDataset(duration_s=12.0, camera=CameraSettings(images=False))
LOST_S = 2.0


def drive(fuser: Fuser, lost_share: float = 0.0, **faults: object) -> tuple[list[NavState], Array]:
    """States of a walk with these faults, and their position errors (N,) m."""
    recording = Faults(**faults).inject(DATASET).open("walk-0")  # type: ignore[arg-type]
    truth = recording.ground_truth()
    vo = SimulatedVO(lost_share=lost_share)
    pipeline = Pipeline(synchronizer=SequentialCacheSynchronizer(), vo=vo, integrator=Preintegration(), fuser=fuser)
    pipeline.setup(recording.rig, initial_state("groundtruth", truth, recording.name))
    vo.take_ground_truth(recording.seen_truth())
    states = list(pipeline.run(recording.packets()))
    poses, covered = interpolate_poses(truth, np.array([s.stamp_ns for s in states]), max_gap_ns=NANOSECONDS)
    assert covered.all()
    return states, np.linalg.norm([s.T_world_body[:3, 3] for s in states] - poses[:, :3, 3], axis=1)


@pytest.mark.parametrize("sensor", ["camera_lost_s", "imu_lost_s"])
@pytest.mark.parametrize("start", [0.0, 5.0])
@pytest.mark.parametrize("fuser", [EkfFuser, MsfFuser, ImuOnlyFuser, VoOnlyFuser])
def test_states_go_on_and_filters_recover(fuser: type[Fuser], start: float, sensor: str) -> None:
    states, errors = drive(fuser(), **{sensor: ((start, LOST_S),)})
    stamps = np.array([state.stamp_ns for state in states])
    elapsed = (stamps - stamps[0]) / NANOSECONDS
    assert elapsed[-1] >= (9.9 if sensor == "camera_lost_s" and start == 0.0 else 11.9)
    usual = np.median(np.diff(elapsed))
    # An image interval, or two where a stand-in meets the first image that is back.
    assert np.diff(elapsed).max() < 2.1 * usual
    assert all(np.isfinite(state.T_world_body).all() for state in states)
    if fuser in (ImuOnlyFuser, VoOnlyFuser):
        return
    assert errors.max() < 2.0
    sigma = np.sqrt([np.trace(state.covariance[6:9, 6:9]) for state in states if state.covariance is not None])
    assert len(sigma) == len(states)
    silent = (elapsed > start + 1.0) & (elapsed < start + LOST_S - 0.1)
    after = elapsed > start + LOST_S + 2.0
    if sensor == "camera_lost_s" and start == 0.0:
        # The recording's truth, and with it the run, begins before the images do.
        return
    assert np.median(sigma[silent]) > 1.5 * np.median(sigma[after])
    if sensor == "camera_lost_s":
        assert {state.status for state, quiet in zip(states, silent, strict=True) if quiet} <= {"tracking", "lost"}
    assert states[-1].status == "tracking"


@pytest.mark.parametrize("fuser", [EkfFuser, ImuOnlyFuser])
def test_what_is_unknown_adds_up_as_one_unknown_motion(fuser: type[Fuser]) -> None:
    """Two silent seconds in windows are as uncertain as at once: (2 m/s²)·(2 s) of vertical velocity.

    Across, what is unknown of the tilt meanwhile turns gravity and adds to it.
    """
    states, _ = drive(fuser(), lost_share=1.0, imu_lost_s=((5.0, LOST_S),))
    stamps = np.array([state.stamp_ns for state in states])
    last = int(np.searchsorted(stamps, stamps[0] + round(6.99 * NANOSECONDS)))
    covariance = states[last].covariance
    assert covariance is not None
    sigma = np.sqrt(np.diag(covariance)[6:9])
    assert sigma[2] == pytest.approx(4.0, rel=0.1)
    assert (sigma[:2] > 4.0).all() and (sigma[:2] < 12.0).all()
