"""One sequence through a pipeline, with everything the evaluation wants to know kept on the way."""

import array
import logging
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from vioframe.conventions import NANOSECONDS
from vioframe.data.exposure import with_exposures
from vioframe.data.recording import Recording, prefetch
from vioframe.errors import ConfigError, VioframeError
from vioframe.evaluation.run import SampleFrame, SequenceRun
from vioframe.geometry.interpolation import differentiate_positions, interpolate_poses
from vioframe.interfaces import UsesGroundTruth
from vioframe.pipeline import InitialState, Pipeline
from vioframe.state_log import StateLog
from vioframe.trajectory_io import tum_lines
from vioframe.types import Measurement, NavState, Packet, Trajectory
from vioframe.viewer import Viewer

log = logging.getLogger(__name__)

INIT_CHOICES = ("auto", "groundtruth")
# What ``auto`` was called while standing still was the only way to start.
_FORMER_NAMES = {"rest": "auto"}
# Ground truth comes at 100 Hz and more where it is good; longer holes (mocap drop-outs) start nothing.
_MAX_TRUTH_GAP_NS = NANOSECONDS // 5

Progress = Callable[[int], None]


class Recorder:
    """Watches a pipeline: states on disk, track counts, a few frames for the report.

    Args:
        folder: for the states and the trajectory written while the run lasts.
        name: of the sequence.
        sample_indices: which windows' frames to keep.
        progress: called with the number of windows done.
    """

    def __init__(self, folder: Path, name: str, sample_indices: Iterable[int], progress: Progress) -> None:
        self.states = StateLog(folder)
        self.track_stamps_ns = array.array("q")
        self.track_counts = array.array("q")
        self.samples: list[SampleFrame] = []
        self.windows = 0
        self._wanted = set(sample_indices)
        self._progress = progress
        # A run that is killed outright still leaves every pose it had.
        self.partial = folder / f"{name.replace('/', '_')}.partial.tum"
        self._stream = self.partial.open("w", encoding="utf-8")
        self._flushed = time.monotonic()

    def watch(self, measurement: Measurement, states: list[NavState]) -> None:
        """Look at what one window gave (an observer of the pipeline)."""
        features = measurement.features
        if features is not None and features.tracks is not None:
            self.track_stamps_ns.append(features.frame.stamp_ns)
            self.track_counts.append(len(features.tracks))
        if self.windows in self._wanted and measurement.window.current.images:
            self.samples.append(_sample(measurement))
        self.windows += 1
        self._progress(self.windows)

    def take(self, states: list[NavState]) -> None:
        """Take states, oldest first."""
        for state in states:
            self.states.append(state)
        if states:
            poses = np.array([state.T_world_body for state in states])
            stamps = np.array([state.stamp_ns for state in states])
            self._stream.write("\n".join(tum_lines(stamps, poses)) + "\n")
        if time.monotonic() - self._flushed > 1.0:
            self._stream.flush()
            self._flushed = time.monotonic()

    def close(self) -> None:
        """The run is over: nothing more will be written on the way."""
        self._stream.close()

    def discard_partial(self) -> None:
        """Remove the trajectory written on the way, once the final files are there."""
        self.partial.unlink(missing_ok=True)


def _sample(measurement: Measurement) -> SampleFrame:
    frame = measurement.window.current
    tracks = None if measurement.features is None else measurement.features.tracks
    if tracks is None:
        return SampleFrame(stamp_ns=frame.stamp_ns, image=frame.images[0].copy())
    return SampleFrame(
        stamp_ns=frame.stamp_ns,
        image=frame.images[0].copy(),
        pixels=tracks.pixels.astype(float),
        ids=tracks.ids.astype(np.int64),
    )


def run_sequence(
    pipeline: Pipeline,
    recording: Recording,
    *,
    folder: Path,
    init: str,
    sample_count: int,
    progress: Progress,
    viewer: Viewer | None = None,
) -> tuple[SequenceRun, Recorder, BaseException | None]:
    """Run one recording to its end, to an error, or to Ctrl-C; in each case what there is comes back.

    Args:
        pipeline: its parts are set up anew.
        recording: opened and checked.
        folder: where the states are kept while the run lasts.
        init: ``auto`` or ``groundtruth``.
        sample_count: frames to keep for the report.
        progress: called with the number of windows done.
        viewer: shows the run while it lasts.

    Returns:
        the record, the recorder that watched, and what stopped the run early, or None.
    """
    truth = recording.ground_truth()
    expected = recording.frame_count
    wanted = [int((k + 0.5) * expected / max(sample_count, 1)) for k in range(sample_count)]
    started = time.perf_counter()
    pipeline.setup(recording.rig, initial_state(init, truth, recording.name))
    users = lend_ground_truth(pipeline, recording.seen_truth(), recording.name)
    if viewer is not None:
        viewer.setup(recording.name, recording.rig, truth, folder)
    recorder = Recorder(folder, recording.name, wanted, progress)
    observers = [recorder.watch] if viewer is None else [recorder.watch, viewer.watch]
    for observer in observers:
        pipeline.observe(observer)
    stop: BaseException | None = None
    delivered = recording.packets()
    packets = prefetch(with_exposures(delivered, recording.rig.camera_delay_ns) if users else delivered)
    try:
        _drive(pipeline, packets, recorder)
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - kept, and raised again by the caller
        stop = error
    finally:
        packets.close()
        for observer in observers:
            pipeline.forget(observer)
        recorder.close()
        if viewer is not None:
            viewer.close()
    counters = dict(recording.counters())
    for part in pipeline.parts().values():
        counters.update(part.counters())
    run = SequenceRun(
        sequence=recording.name,
        states=recorder.states,
        smoothed=None if stop is not None else pipeline.fuser.smoothed(),
        ground_truth=truth,
        frames_expected=expected,
        duration_s=recording.duration_s,
        pipeline_s=pipeline.seconds,
        parts_s={slot: timer.seconds for slot, timer in pipeline.timers.items()},
        windows=pipeline.windows,
        wall_s=time.perf_counter() - started,
        counters={name: count for name, count in counters.items() if count},
        track_stamps_ns=np.array(recorder.track_stamps_ns, dtype=np.int64),
        track_counts=np.array(recorder.track_counts, dtype=np.int64),
        sample_frames=recorder.samples,
        attempts=tuple(pipeline.fuser.attempts()),
        calibration=pipeline.fuser.calibration(),
        init=_FORMER_NAMES.get(init, init),
        uses_ground_truth=users,
        faults=recording.faults(),
        error=_say(stop, recorder.windows, expected) if stop or pipeline.windows else _nothing_ran(init),
        interrupted=isinstance(stop, KeyboardInterrupt),
    )
    return run, recorder, stop


def _drive(pipeline: Pipeline, packets: Iterable[Packet], recorder: Recorder) -> None:
    for packet in packets:
        recorder.take(pipeline.push(packet))
    recorder.take(pipeline.flush())


def _say(stop: BaseException | None, done: int, expected: int) -> str | None:
    if stop is None:
        return None
    if isinstance(stop, KeyboardInterrupt):
        return f"interrupted after {done} of {max(expected - 1, 0)} image pairs; what was computed is kept"
    if isinstance(stop, VioframeError):
        return str(stop)
    return f"{type(stop).__name__}: {stop}"


def _nothing_ran(init: str) -> str:
    """Why a recording that came to its end gave not one window."""
    if init == "groundtruth":
        return "init=groundtruth, but the ground truth has no pose at any image: use init=auto"
    return "no image could be paired with inertial samples, so nothing was estimated: check that both clocks overlap"


def initial_state(init: str, truth: Trajectory | None, sequence: str) -> InitialState | None:
    """The function that gives the pipeline its first state, or None where the fuser starts by itself.

    Raises:
        ConfigError: an unknown ``init``, or no ground truth to start from.
    """
    init = _FORMER_NAMES.get(init, init)
    if init not in INIT_CHOICES:
        raise ConfigError(f"init={init} is unknown: choose one of {', '.join(INIT_CHOICES)}")
    if init == "auto":
        return None
    if truth is None:
        raise ConfigError(f"init=groundtruth, but {sequence} has no ground truth: use init=auto")
    velocity = differentiate_positions(truth)
    known = truth

    def look_up(stamp_ns: int) -> NavState | None:
        poses, covered = interpolate_poses(known, np.array([stamp_ns], dtype=np.int64), max_gap_ns=_MAX_TRUTH_GAP_NS)
        if not covered[0]:
            return None
        at_stamp = np.array(
            [np.interp(stamp_ns - known.stamps_ns[0], known.stamps_ns - known.stamps_ns[0], v) for v in velocity.T]
        )
        return NavState(stamp_ns=stamp_ns, T_world_body=poses[0], v_world_body=at_stamp)

    return look_up


def lend_ground_truth(pipeline: Pipeline, truth: Trajectory | None, sequence: str) -> tuple[str, ...]:
    """Hand the truth to the parts that simulate a sensor from it; return their names for the protocol.

    Raises:
        ConfigError: such a part is chosen, and the recording has no ground truth.
    """
    users = []
    for slot, part in pipeline.parts().items():
        if isinstance(part, UsesGroundTruth):
            name = f"{slot}={pipeline.choices.get(slot, type(part).__name__)}"
            if truth is None:
                raise ConfigError(f"{name} needs ground truth, but {sequence} has none: choose another {slot}")
            part.take_ground_truth(truth)
            users.append(name)
    return tuple(users)
