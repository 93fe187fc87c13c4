"""What an experiment hands to the evaluation: the record of one sequence, finished or not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vioframe.checks import Array, Stamps, check_array
from vioframe.types import Image, InitialisationAttempt, Measure, NavState, Trajectory

RunStatus = Literal["finished", "failed", "interrupted"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleFrame:
    """An image kept for the report, with the tracks that the front end had on it.

    Attributes:
        stamp_ns: IMU clock.
        image: (H, W) or (H, W, 3) uint8.
        pixels: (M, 2) px, x right, y down; empty where the system follows no points.
        ids: (M,) int64, lasting.
    """

    stamp_ns: int
    image: Image
    pixels: Array = field(default_factory=lambda: np.zeros((0, 2)))
    ids: Stamps = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        check_array("SampleFrame.ids", self.ids, (None,), np.int64)
        check_array("SampleFrame.pixels", self.pixels, (len(self.ids), 2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SequenceRun:
    """One sequence, run through a pipeline.

    Attributes:
        sequence: name, also used for folders.
        states: what the fuser gave while it ran, of every status, oldest first, each stamp once.
        smoothed: the final trajectory (``causal=False``), where the fuser has one.
        ground_truth: where the recording has one, on the IMU clock.
        frames_expected: images of the recording, the first included.
        duration_s: length of the recording.
        pipeline_s: wall seconds inside the pipeline.
        parts_s: of these, the seconds inside each part's own methods.
        windows: pairs of images that were processed.
        wall_s: wall seconds from opening the recording to its end, reading and rendering included.
        counters: what happened that a user should know, such as ``{"dropped frames": 3}``.
        track_stamps_ns: (K,) IMU clock, when points were counted; empty without a front end.
        track_counts: (K,) number of points followed.
        sample_frames: a few images for the report.
        attempts: to start, oldest first.
        calibration: what of it the fuser estimated, by name, as the change from the rig's.
        init: how the fuser was started, ``"auto"``, by itself, or ``"groundtruth"``.
        uses_ground_truth: names of the parts that simulate a sensor from the truth.
        faults: what was spoilt on purpose in the recording.
        error: what went wrong, in one sentence, or None.
        interrupted: the user stopped the run; ``error`` may say at which stamp.
    """

    sequence: str
    states: Sequence[NavState]
    smoothed: Trajectory | None = None
    ground_truth: Trajectory | None = None
    frames_expected: int
    duration_s: float
    pipeline_s: float
    parts_s: Mapping[str, float] = field(default_factory=dict)
    windows: int
    wall_s: float
    counters: Mapping[str, int] = field(default_factory=dict)
    track_stamps_ns: Stamps = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    track_counts: Stamps = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    sample_frames: Sequence[SampleFrame] = ()
    attempts: Sequence[InitialisationAttempt] = ()
    calibration: Mapping[str, Measure] = field(default_factory=dict)
    init: str = "auto"
    uses_ground_truth: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    error: str | None = None
    interrupted: bool = False

    def __post_init__(self) -> None:
        check_array("SequenceRun.track_stamps_ns", self.track_stamps_ns, (None,), np.int64)
        check_array("SequenceRun.track_counts", self.track_counts, (len(self.track_stamps_ns),), np.int64)

    @property
    def status(self) -> RunStatus:
        """How the sequence ended."""
        if self.interrupted:
            return "interrupted"
        return "finished" if self.error is None else "failed"
