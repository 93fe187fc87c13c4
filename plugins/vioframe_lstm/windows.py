"""Windows of the pose head cut from a row of pairs, and their answers put one after the other."""

from collections.abc import Sequence

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.geometry import se3
from vioframe_lstm.pairs import Pairs
from vioframe_lstm.stack import Paths, carried, flat, window_stack


def needed_ends(length: int, answered: int, frames: int) -> list[int]:
    """Ends of the windows, in pairs, on which the last ``answered`` motions of ``length`` pairs depend."""
    ends = set(range(length - answered, length + 1)) - {0}
    for end in sorted(ends, reverse=True):
        ends |= set(range(end - frames, 0, -frames))
    return sorted(ends)


def starts_of(ends: Sequence[int], frames: int) -> np.ndarray:
    """Numbers (A,) of the images at which windows that end after these pairs begin."""
    starts: np.ndarray = np.maximum(np.array(ends) - frames, 0)
    return starts


def stacks(
    pairs: Pairs, paths: Paths, ends: Sequence[int], frames: int, T_first_start: Array | None
) -> tuple[Array, Array, Mask]:
    """What the net is shown of windows of ``frames`` pairs, or of as many as there are.

    Args:
        pairs: (B, S) in a row.
        paths: of the same pairs.
        ends: of A windows, 1 … S.
        frames: M.
        T_first_start: (B, A, 4, 4) where the windows start, for poses since the beginning; None: since their start.

    Returns:
        R (B·A, M, N + 1, 3, 3), p (B·A, M, N + 1, 3) m, and which frames are there (B·A, M).
    """
    index = np.array(ends)[:, None] + np.arange(-frames, 0)
    present = np.broadcast_to(index >= 0, (len(pairs.visual), *index.shape)).reshape(-1, frames)
    index = np.maximum(index, 0)
    windows = pairs.of_pairs(lambda values: flat(values[:, index]), each=len(ends))
    R, p = window_stack(windows, paths.at(index), present)
    if T_first_start is not None:
        R, p = carried(flat(T_first_start), R, p)
    return R, p, present


def chain_answers(answers: Array, ends: Sequence[int], frames: int, *, absolute: bool) -> dict[int, Array]:
    """Poses (B, 4, 4) since the beginning at each end, a window being hung up where its start was put before.

    Args:
        answers: (B, A, 4, 4).
        ends: of the A windows, in order.
        frames: M.
        absolute: the answers are since the beginning already.
    """
    poses: dict[int, Array] = {0: np.broadcast_to(np.eye(4), (len(answers), 4, 4))}
    for place, end in enumerate(ends):
        T = answers[:, place]
        poses[end] = T if absolute else poses[max(end - frames, 0)] @ T
    return poses


def true_poses(T_prev_cur: Array, T_body_cam: Array, ends: Sequence[int], frames: int, *, absolute: bool) -> Array:
    """What should have been answered, (B, A, 4, 4), of true motions (B, S, 4, 4) of the camera."""
    T = np.broadcast_to(np.eye(4), T_prev_cur[:, 0].shape)
    poses = [T]
    for motion in np.moveaxis(T_prev_cur, 1, 0):
        T = T @ motion
        poses.append(T)
    T_first_body = T_body_cam[:, None] @ np.stack(poses, axis=1) @ se3.inverse(T_body_cam)[:, None]
    end = T_first_body[:, list(ends)]
    return end if absolute else se3.inverse(T_first_body[:, starts_of(ends, frames)]) @ end
