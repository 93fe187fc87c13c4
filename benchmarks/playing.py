"""Systems composed as the command line composes them, played over recordings that are drawn once; CPU time by part.

What a system is given here is what ``python -m vioframe`` would give it, packet by packet, and errors come from
vioframe's own evaluation. Only the clock differs: CPU time of the process, one thread, and of every image alone.
"""

import hashlib
import math
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from vioframe.build import build, build_pipeline
from vioframe.data.recording import Dataset, Recording
from vioframe.evaluation.rows import Row, evaluate_run
from vioframe.evaluation.run import SequenceRun
from vioframe.pipeline import SLOTS, Pipeline
from vioframe.plugins import core_conf, extend_hydra
from vioframe.tasks.run_sequence import initial_state
from vioframe.types import Frame, InitialisationAttempt, NavState, Packet, SensorRig, Trajectory

PARTS = ("total", "frontend", "fuser", "integrator")
_METHODS = {"frontend": "process", "integrator": "integrate", "fuser": "update"}
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def use_one_thread() -> None:
    """One thread for OpenCV and for BLAS; the latter decides at import, so the process begins again if need be."""
    if any(os.environ.get(name) != "1" for name in _THREADS):
        os.environ.update(dict.fromkeys(_THREADS, "1"))
        os.execv(sys.executable, sys.orig_argv)
    cv2.setNumThreads(1)


def compose_config(*overrides: str) -> DictConfig:
    """The config of a command line with these overrides."""
    GlobalHydra.instance().clear()
    extend_hydra()
    with initialize_config_dir(str(core_conf()), version_base="1.3"):
        return compose("config", overrides=["tracker=none", *overrides])


def open_recording(*overrides: str) -> Recording:
    """The first recording of the data set that these overrides choose."""
    dataset = build(compose_config(*overrides), "dataset", Dataset)
    return dataset.open(dataset.sequences[0])


class DrawnRecording(Recording):
    """A recording whose images were drawn into a file.

    Args:
        path: of the file, without its suffix.
        cameras: how many of its cameras to look through.
    """

    def __init__(self, path: Path, cameras: int) -> None:
        with path.with_suffix(".pkl").open("rb") as stream:
            kept = pickle.load(stream)
        self.name: str = kept["name"]
        self._rig: SensorRig = replace(kept["rig"], cameras=kept["rig"].cameras[:cameras])
        self._packets = kept["packets"]
        self._truth: Trajectory = kept["truth"]
        self._images = np.load(path.with_suffix(".npy"), mmap_mode="r")

    @property
    def rig(self) -> SensorRig:
        """Calibration."""
        return self._rig

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self._images)

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last frame."""
        stamps = [packet[1] for packet in self._packets if isinstance(packet, tuple)]
        return (stamps[-1] - stamps[0]) * 1e-9

    def ground_truth(self) -> Trajectory:
        """True poses of the body."""
        return self._truth

    def packets(self) -> Iterator[Packet]:
        """Stream from the start."""
        for packet in self._packets:
            if isinstance(packet, tuple):
                index, stamp_ns = packet
                images = tuple(np.array(self._images[index, camera]) for camera in range(len(self._rig.cameras)))
                yield Frame(stamp_ns=stamp_ns, images=images)
            else:
                yield packet


def draw(scratch: Path, *overrides: str) -> Path:
    """Draw a recording into ``scratch``, unless it is there from an earlier time; return the path without suffix."""
    key = hashlib.sha256(" ".join(overrides).encode()).hexdigest()[:12]
    path = scratch / f"drawn_{key}"
    if path.with_suffix(".pkl").exists():
        return path
    recording = open_recording(*overrides)
    cameras = recording.rig.cameras
    shape = (recording.frame_count, len(cameras), *cameras[0].size_px[::-1])
    scratch.mkdir(parents=True, exist_ok=True)
    unfinished = scratch / f"drawn_{key}.{os.getpid()}.npy"
    images = np.lib.format.open_memmap(unfinished, mode="w+", dtype=np.uint8, shape=shape)
    packets: list[object] = []
    count = 0
    for packet in recording.packets():
        if isinstance(packet, Frame):
            for camera, image in enumerate(packet.images):
                images[count, camera] = image
            packets.append((count, packet.stamp_ns))
            count += 1
        else:
            packets.append(packet)
    images.flush()
    unfinished.rename(path.with_suffix(".npy"))
    kept = {"name": recording.name, "rig": recording.rig, "packets": packets, "truth": recording.ground_truth()}
    path.with_suffix(".pkl").write_bytes(pickle.dumps(kept))
    return path


@dataclass(frozen=True)
class Played:
    """What became of a recording in a system.

    Attributes:
        row: the metrics, as in ``metrics.json``.
        states: as they came.
        smoothed: the final trajectory, where there is one.
        truth: poses of the body.
        cpu_ms: (N, 4) CPU milliseconds of each image: :data:`PARTS`.
        delays_ns: (N,) delay of the camera as estimated after each image, or the rig's.
        T_body_cam: (4, 4) of camera 0, as estimated in the end.
        attempts: to start.
    """

    row: Row
    states: list[NavState]
    smoothed: Trajectory | None
    truth: Trajectory | None
    cpu_ms: np.ndarray
    delays_ns: np.ndarray
    T_body_cam: np.ndarray
    attempts: list[InitialisationAttempt]

    @property
    def ate_m(self) -> float:
        """Causal, SE(3); infinite where there is none."""
        value = self.row["ate_se3_m"]
        return float(value) if isinstance(value, int | float) else math.inf

    @property
    def final_ate_m(self) -> float:
        """Of the final trajectory; infinite where there is none."""
        final = self.row["final"]
        value = final.get("ate_se3_m") if isinstance(final, dict) else None
        return float(value) if isinstance(value, int | float) else math.inf

    @property
    def started_s(self) -> float:
        """When the first state came, s after the truth begins; infinite where none came."""
        first = next((state.stamp_ns for state in self.states if state.status == "tracking"), None)
        return math.inf if first is None or self.truth is None else (first - int(self.truth.stamps_ns[0])) * 1e-9

    def cpu(self) -> dict[str, float]:
        """Mean and 95th percentile of an image, CPU milliseconds: tracking, back end, framework and all."""
        if not len(self.cpu_ms):
            return {}
        total, tracking, fuser, integrator = self.cpu_ms.T
        columns = {"total": total, "tracking": tracking, "back end": fuser + integrator}
        columns["framework"] = total - tracking - columns["back end"]
        return {
            name + suffix: float(value)
            for name, column in columns.items()
            for suffix, value in (("", column.mean()), (" p95", np.percentile(column, 95)))
        }


class _Stopwatch:
    """CPU seconds inside the parts' methods since it was last read."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.seconds = dict.fromkeys(_METHODS, 0.0)
        for slot, part in pipeline.parts().items():
            if slot in _METHODS:
                setattr(part, _METHODS[slot], self._timed(slot, getattr(part, _METHODS[slot])))

    def _timed(self, slot: str, method: Callable[..., object]) -> Callable[..., object]:
        def timed(*arguments: object, **named: object) -> object:
            started = time.process_time()
            try:
                return method(*arguments, **named)
            finally:
                self.seconds[slot] += time.process_time() - started

        return timed

    def read(self) -> list[float]:
        """Seconds of frontend, fuser and integrator; starts anew."""
        told = [self.seconds[part] for part in PARTS[1:]]
        self.seconds = dict.fromkeys(_METHODS, 0.0)
        return told


def play(recording: Recording, system: Sequence[str], init: str = "auto") -> Played:
    """Run a recording through the system that these overrides choose.

    Args:
        recording: with as many cameras as the system's ``rig=`` says.
        system: overrides, such as ``["fuser=msckf", "rig=stereo"]``.
        init: ``auto`` or ``groundtruth``.
    """
    config = compose_config(*system)
    choices = {slot: value for slot, _, value in (one.partition("=") for one in system) if slot in SLOTS}
    pipeline = build_pipeline(config, choices)
    truth = recording.ground_truth()
    pipeline.setup(recording.rig, initial_state(init, truth, recording.name))
    watch = _Stopwatch(pipeline)
    states: list[NavState] = []
    spent, costs, delays = 0.0, [], []
    started = time.perf_counter()
    for packet in recording.packets():
        windows = pipeline.windows
        before = time.process_time()
        states += pipeline.push(packet)
        spent += time.process_time() - before
        if pipeline.windows > windows:
            costs.append([spent, *watch.read()])
            spent = 0.0
            delay_ns = pipeline.fuser.camera_delay_ns()
            delays.append(recording.rig.camera_delay_ns if delay_ns is None else delay_ns)
    states += pipeline.flush()
    cpu_ms = 1e3 * np.array(costs).reshape(-1, len(PARTS))
    counters = dict(recording.counters())
    for part in pipeline.parts().values():
        counters |= part.counters()
    run = SequenceRun(
        sequence=recording.name,
        states=states,
        smoothed=pipeline.fuser.smoothed(),
        ground_truth=truth,
        frames_expected=recording.frame_count,
        duration_s=recording.duration_s,
        pipeline_s=max(float(cpu_ms[:, 0].sum()) / 1e3, 1e-9),
        windows=pipeline.windows,
        wall_s=time.perf_counter() - started,
        counters={name: count for name, count in counters.items() if count},
        init=init,
        faults=recording.faults(),
    )
    estimate = getattr(pipeline.fuser, "T_body_cam", None)
    return Played(
        row=evaluate_run(run),
        states=states,
        smoothed=run.smoothed,
        truth=truth,
        cpu_ms=cpu_ms,
        delays_ns=np.array(delays),
        T_body_cam=estimate() if estimate is not None else recording.rig.cameras[0].T_body_cam,
        attempts=list(pipeline.fuser.attempts()),
    )
