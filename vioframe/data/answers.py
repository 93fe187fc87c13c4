"""What a VO answered for a recording, kept on disk: a fuser is trained on it as often as one likes."""

import hashlib
import os
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vioframe.checks import Stamps
from vioframe.data.windows import PairAnswers
from vioframe.errors import DataError, VioframeError
from vioframe.geometry import so3
from vioframe.types import RelativePose


def stack_answers(stamps_ns: Stamps, poses: Mapping[tuple[int, int], RelativePose]) -> PairAnswers:
    """Answers in the order of the images.

    Args:
        stamps_ns: (F,) of the images, IMU clock.
        poses: by the stamps of both images; a pair that is missing was not answered, and is not valid.
    """
    pairs = len(stamps_ns) - 1
    T_prev_cur = np.tile(np.eye(4), (pairs, 1, 1))
    covariance = np.zeros((pairs, 6, 6))
    valid = np.zeros(pairs, dtype=np.bool_)
    for number in range(pairs):
        pose = poses.get((int(stamps_ns[number]), int(stamps_ns[number + 1])))
        if pose is None or not pose.valid:
            continue
        valid[number] = True
        T_prev_cur[number] = pose.T_prev_cur
        if pose.covariance is not None:
            covariance[number] = pose.covariance
    T_prev_cur[:, :3, :3] = so3.normalise(T_prev_cur[:, :3, :3])
    return PairAnswers(T_prev_cur=T_prev_cur, covariance=covariance, valid=valid)


def answers_digest(answers: PairAnswers) -> str:
    """A hash of all that was answered."""
    digest = hashlib.sha256()
    for array in (answers.T_prev_cur, answers.covariance, answers.valid):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def write_answers(path: Path, answers: PairAnswers) -> None:
    """Keep answers; a reader sees all of the file or none.

    Raises:
        DataError: the folder cannot be written to.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(dir=path.parent, suffix=".partial")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(
                    file,
                    allow_pickle=False,
                    T_prev_cur=answers.T_prev_cur,
                    covariance=answers.covariance,
                    valid=answers.valid,
                )
            os.replace(partial, path)
        finally:
            Path(partial).unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f"{path.parent} cannot be written to: {error.strerror}") from error


def read_answers(path: Path) -> PairAnswers:
    """What :func:`write_answers` kept.

    Raises:
        DataError: the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            return PairAnswers(T_prev_cur=stored["T_prev_cur"], covariance=stored["covariance"], valid=stored["valid"])
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, VioframeError) as error:
        raise DataError(f"{path} is damaged ({error}): delete it, and the VO is asked again") from error
