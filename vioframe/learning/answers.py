"""What a VO with a net answers for stored recordings: in batches where they say the same as a stream, else in a stream.

A stream is what an experiment runs, so a stream is what counts. A batch is several times as fast; whether a part says
the same both ways is tried at the beginning of the first recording that is long enough: one that remembers more than a
window holds does not, and is asked in a stream throughout.
"""

import logging
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch
from torch import Tensor

from vioframe.checks import Array
from vioframe.data.answers import stack_answers
from vioframe.data.windows import PairAnswers, StoredSequence, WindowIndex
from vioframe.errors import DataError
from vioframe.geometry import se3, so3
from vioframe.interfaces import Frontend, Trainable, VOEstimator
from vioframe.learning.batch import collate
from vioframe.learning.module import MOTION
from vioframe.learning.motion import covariance_from_log_variances, vector_from_motion
from vioframe.types import Frame, ImuNoise, RelativePose, SensorRig, VisualFeatures

log = logging.getLogger(__name__)

# Pairs that a window answers beyond the first, so that what answers share is found once.
_FURTHER_PAIRS = 15
# Answers of a stream that batches are held against.
_HELD_PAIRS = 24
# What single precision makes of the same sums in another order, rad and share of the distance.
_SAME_RAD = 1e-4
_SAME_SHARE = 1e-3
_NO_NOISE = ImuNoise(gyro_noise=0.0, gyro_walk=0.0, accel_noise=0.0, accel_walk=0.0, rate_hz=100.0)


class LearnedAnswers:
    """Asks a VO with a net, and the front end before it, for the motions of stored recordings.

    Args:
        frontend: or None where the VO reads images.
        vo: with a net.
        batch_size: windows that are answered at once.

    Attributes:
        in_batches: False as soon as batches were found to answer otherwise.
    """

    def __init__(self, frontend: Frontend | None, vo: VOEstimator, batch_size: int) -> None:
        self._frontend = frontend
        self._vo = vo
        self._parts: list[Trainable] = []
        for part in (frontend, vo):
            if isinstance(part, Trainable):
                self._parts.append(part)
        self._batch_size = batch_size
        self._held = False
        # A front end that takes no part in training can only be asked in a stream.
        self.in_batches = isinstance(vo, Trainable) and len(self._parts) == 1 + (frontend is not None)

    def answer(self, sequence: StoredSequence, progress: Callable[[int], None] = lambda done: None) -> PairAnswers:
        """What it answers for all pairs of a recording with images.

        Args:
            sequence: the recording, whose truth is not looked at.
            progress: told how many pairs are done.
        """
        rig = SensorRig(cameras=(sequence.camera,), imu=_NO_NOISE, gravity=sequence.gravity)
        answers: dict[int, RelativePose] = {}
        for first, last in _runs(sequence):
            answers.update(self._run(rig, sequence, first, last, partial(_tell, progress, len(answers))))
        stamps = sequence.stamps_ns.tolist()
        return stack_answers(
            sequence.stamps_ns, {(stamps[pair], stamps[pair + 1]): pose for pair, pose in answers.items()}
        )

    def _run(
        self, rig: SensorRig, sequence: StoredSequence, first: int, last: int, progress: Callable[[int], None]
    ) -> dict[int, RelativePose]:
        """Answers by the number of the pair, of the unbroken images ``first`` to ``last``."""
        context = max((part.context_pairs for part in self._parts), default=1)
        if not self.in_batches or last - first < context:
            return self._stream(rig, sequence, first, last, progress)
        # The first answers of a stream have less to look back at than a window has.
        begun = min(last, first + context - 1 + (0 if self._held else context + _FURTHER_PAIRS + _HELD_PAIRS))
        streamed = self._stream(rig, sequence, first, begun, progress)
        batched = self._batch(sequence, first, last, context, progress)
        if not self._held:
            both = [(streamed[pair], batched[pair]) for pair in streamed if pair in batched]
            if not all(_alike(one, other) for one, other in both):
                log.info("%s remembers more than a window holds: it is asked image by image", type(self._vo).__name__)
                self.in_batches = False
                return self._stream(rig, sequence, first, last, progress)
            # A run that begins and ends within one window says nothing of what is remembered beyond it.
            self._held = begun - first > context + _FURTHER_PAIRS
        return {**streamed, **batched}

    def _stream(
        self, rig: SensorRig, sequence: StoredSequence, first: int, last: int, progress: Callable[[int], None]
    ) -> dict[int, RelativePose]:
        if last == first:
            return {}
        for part in (self._frontend, self._vo):
            if part is not None:
                part.setup(rig)
        answers: dict[int, RelativePose] = {}
        previous: VisualFeatures | None = None
        for number in range(first, last + 1):
            image = np.asarray(sequence.images[number])
            frame = Frame(
                stamp_ns=int(sequence.stamps_ns[number]), images=(image[..., 0] if image.shape[-1] == 1 else image,)
            )
            current = VisualFeatures(frame=frame) if self._frontend is None else self._frontend.process(frame, None)
            if previous is not None:
                answers[number - 1] = self._vo.estimate(previous, current)
            previous = current
            progress(len(answers))
        return answers

    def _batch(
        self, sequence: StoredSequence, first: int, last: int, context: int, progress: Callable[[int], None]
    ) -> dict[int, RelativePose]:
        pairs = min(context + _FURTHER_PAIRS, last - first)
        index = WindowIndex([_cut(sequence, first, last)], pairs, split="answers").tiled(pairs - context + 1)
        answers: dict[int, RelativePose] = {}
        for start in range(0, len(index), self._batch_size):
            windows = [index[number] for number in range(start, min(start + self._batch_size, len(index)))]
            batch = collate(windows).as_float()
            with torch.inference_mode():
                known: dict[str, Tensor] = {}
                for part in self._parts:
                    net = part.net.eval()
                    device = next((each.device for each in net.parameters()), batch.images.device)
                    batch = batch.to(device)
                    known.update(part.forward_batch(batch, {name: each.to(device) for name, each in known.items()}))
            if MOTION not in known:
                raise DataError(f"{type(self._vo).__name__} answers no {MOTION} in batches, which a fuser learns from")
            motions, covariances = _numbers(known)
            for window, T_prev_cur, covariance in zip(windows, motions, covariances, strict=True):
                place = first + window.start + pairs - len(T_prev_cur)
                for offset, (T, stated) in enumerate(zip(T_prev_cur, covariance, strict=True)):
                    answers.setdefault(place + offset, _pose(T, stated))
            progress(len(answers))
        return answers


def _tell(progress: Callable[[int], None], before: int, further: int) -> None:
    progress(before + further)


def _runs(sequence: StoredSequence) -> list[tuple[int, int]]:
    """First and last image of each stretch without a missing image; no truth is needed."""
    starts = _cut(sequence, 0, len(sequence) - 1).starts(1)
    breaks = np.flatnonzero(np.diff(starts) != 1) + 1
    return [(int(run[0]), int(run[-1]) + 1) for run in np.split(starts, breaks) if len(run)]


def _cut(sequence: StoredSequence, first: int, last: int) -> StoredSequence:
    """Images ``first`` to ``last`` alone, as if all were known; what a VO says does not depend on the truth."""
    kept = slice(first, last + 1)
    return StoredSequence(
        name=sequence.name,
        images=sequence.images[kept],
        stamps_ns=sequence.stamps_ns[kept],
        T_world_cam=sequence.T_world_cam[kept],
        known=np.ones(last + 1 - first, dtype=np.bool_),
        imu=sequence.imu,
        camera=sequence.camera,
        gravity=sequence.gravity,
        truth=sequence.truth,
    )


def _numbers(known: Mapping[str, Tensor]) -> tuple[Array, Array]:
    """Motions (B, K, 4, 4), and covariances (B, K, 6, 6), which are zero where none is stated."""
    motions = known[MOTION].detach().double().cpu()
    shape = (*motions.shape[:2], 6, 6)
    if "log_variances" in known:
        stated = known["log_variances"][:, -motions.shape[1] :].detach().double().cpu()
        covariance = covariance_from_log_variances(vector_from_motion(motions), stated)
        return motions.numpy(), covariance.numpy()
    if "covariance" in known:
        return motions.numpy(), known["covariance"][:, -motions.shape[1] :].detach().double().cpu().numpy()
    return motions.numpy(), np.zeros(shape)


def _pose(T_prev_cur: Array, covariance: Array) -> RelativePose:
    if not np.isfinite(T_prev_cur).all() or not np.isfinite(covariance).all():
        return RelativePose.invalid()
    clean = T_prev_cur.copy()
    clean[:3, :3] = so3.normalise(clean[:3, :3])
    symmetric = 0.5 * (covariance + covariance.T)
    return RelativePose(T_prev_cur=clean, covariance=symmetric if symmetric.any() else None)


def _alike(one: RelativePose, other: RelativePose) -> bool:
    if one.valid != other.valid:
        return False
    error = se3.log(se3.inverse(one.T_prev_cur) @ other.T_prev_cur)
    distance = float(np.linalg.norm(one.T_prev_cur[:3, 3]))
    return float(np.linalg.norm(error[:3])) < _SAME_RAD and float(np.linalg.norm(error[3:])) < _SAME_SHARE * max(
        distance, 0.1
    )
