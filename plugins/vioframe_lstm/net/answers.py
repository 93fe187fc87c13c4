"""Poses of the pose head for a batch of stretches: windows cut, answered, and put one after the other."""

from collections.abc import Sequence

import torch
from torch import Tensor

from vioframe.learning.motion import compose, from_parts, inverse, product
from vioframe_lstm.net.pairs import Pairs
from vioframe_lstm.net.pose import PoseNet
from vioframe_lstm.net.stack import Paths, chained, filled, window_stack


def needed_ends(length: int, answered: int, frames: int) -> list[int]:
    """Ends of the windows, in pairs, on which the last ``answered`` motions of ``length`` pairs depend."""
    ends = set(range(length - answered, length + 1)) - {0}
    for end in sorted(ends, reverse=True):
        ends |= set(range(end - frames, 0, -frames))
    return sorted(ends)


def answer_windows(
    net: PoseNet, pairs: Pairs, paths: Paths, ends: Sequence[int], frames: int, starts: Tensor | None
) -> Tensor:
    """Pose (B, A, 4, 4) of the body after the first ``end`` pairs, for A ends, since the start of the window.

    A window has ``frames`` pairs, or as many as there are.

    Args:
        net: that answers.
        pairs: (B, S) in a row.
        paths: of the same pairs.
        ends: 1 … S.
        frames: M.
        starts: (B, A, 4, 4) where the windows start, for a net that is shown, and puts out, poses since the beginning.
    """
    count, device = pairs.visual.shape[0], pairs.visual.device
    last = torch.tensor(list(ends), device=device)
    index = last[:, None] + torch.arange(-frames, 0, device=device)
    present = (index >= 0).expand(count, *index.shape).flatten(0, 1)
    index = index.clamp_min(0)
    windows = pairs.of_pairs(lambda value: value[:, index].flatten(0, 1), each=len(ends))
    R, p = window_stack(windows, paths.at(index), present)
    if starts is not None:
        R, p = _carried(starts.flatten(0, 1), R, p)
    T: Tensor = net(R, p, present)
    return T.reshape(count, len(ends), 4, 4)


def visual_poses(pairs: Pairs) -> Tensor:
    """Poses (B, S + 1, 4, 4) of the body since the first, by the VO alone."""
    T_first_cur = from_parts(*chained(*filled(pairs)))
    identity = torch.eye(4, dtype=T_first_cur.dtype, device=T_first_cur.device).expand_as(T_first_cur[:, :1])
    return torch.cat([identity, T_first_cur], dim=1)


def _carried(T: Tensor, R: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """Stacks (W, M, N + 1, …) seen from where the start has the poses (W, 4, 4)."""
    turn, shift = T[:, None, None, :3, :3], T[:, None, None, :3, 3]
    return product(turn, R), product(turn, p[..., None])[..., 0] + shift


def chain_answers(answers: Tensor, ends: Sequence[int], frames: int, *, absolute: bool) -> dict[int, Tensor]:
    """Poses (B, 4, 4) since the beginning at each end, a window being hung up where its start was put before."""
    poses = {0: torch.eye(4, dtype=answers.dtype, device=answers.device).expand(len(answers), 4, 4)}
    for place, end in enumerate(ends):
        T = answers[:, place]
        poses[end] = T if absolute else product(poses[max(end - frames, 0)], T)
    return poses


def true_poses(T_prev_cur: Tensor, T_body_cam: Tensor, ends: Sequence[int], frames: int, *, absolute: bool) -> Tensor:
    """What :func:`answer_windows` should have answered, of true motions (B, S, 4, 4) of the camera."""
    T_first_cam = compose(T_prev_cur)
    T_first_body = product(product(T_body_cam[:, None], T_first_cam), inverse(T_body_cam)[:, None])
    last = torch.tensor(list(ends), device=T_prev_cur.device)
    end = T_first_body[:, last]
    return end if absolute else product(inverse(T_first_body[:, (last - frames).clamp_min(0)]), end)
