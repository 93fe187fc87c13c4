"""Images, pairs and keyframes of a window in motion, in the shapes that the solvers take."""

from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.geometry import so3
from vioframe.inertial import level
from vioframe.tight.gyro_bias import PairedPoints, RotationFit
from vioframe.tight.inertial_window import InertialWindow
from vioframe.tight.linear_alignment import Alignment, Path, Views
from vioframe.tight.motion_window import Sight
from vioframe.tight.start_bundle import Sightings, WindowState
from vioframe.types import ImuBias

_KEY_SPACING_S = 0.22
_MOST_KEYS = 14
_MOST_POINTS = 90
_PAIR_POINTS = 70


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Geometry:
    """The keyframes with their rotations: what the linear and the bundled solution share."""

    sight: Sight
    fit: RotationFit
    T_body_cams: tuple[Array, ...]
    inertial: InertialWindow


def moved(sight: Sight, delay_s: float, inertial: InertialWindow) -> Sight:
    """The images at the instants when they were taken, as far as there are inertial samples."""
    times = sight.times + delay_s
    covered = (times >= inertial.elapsed[0]) & (times <= inertial.elapsed[-1])
    return replace(sight, times=times).at(np.flatnonzero(covered))


def spaced(times: Array, spacing_s: float) -> Stamps:
    """Indices of times about ``spacing_s`` apart, the first and the last included."""
    count = max(round((times[-1] - times[0]) / spacing_s) + 1, 2)
    wanted = np.linspace(times[0], times[-1], count)
    return np.unique(np.abs(times[None] - wanted[:, None]).argmin(axis=1))


def turn_deg(R_prev_cur: Array) -> float:
    """Largest angle, degrees, between the first image and another, from the rotations between successive ones."""
    R, largest = np.eye(3), 0.0
    for turn in R_prev_cur:
        R = R @ turn
        largest = max(largest, float(so3.angle(R)))
    return float(np.degrees(largest))


def paired(sight: Sight, stride: int, sigma: float) -> PairedPoints:
    """Pairs of images ``stride`` apart, with up to ``_PAIR_POINTS`` points in common."""
    first, second = np.arange(len(sight.times) - stride), np.arange(stride, len(sight.times))
    both = sight.seen[first] & sight.seen[second]
    most = int(np.clip(both.sum(axis=1).max(), 1, _PAIR_POINTS))
    at = np.argsort(~both, axis=1, kind="stable")[:, :most]
    return PairedPoints(
        starts=sight.times[first],
        ends=sight.times[second],
        first=np.take_along_axis(sight.bearings[first], at[..., None], axis=1),
        second=np.take_along_axis(sight.bearings[second], at[..., None], axis=1),
        common=np.take_along_axis(both, at, axis=1),
        sigma=sigma,
    )


def keyframes(sight: Sight) -> Sight:
    """Fewer images, and the points that most of them see."""
    spacing = max(_KEY_SPACING_S, float(sight.times[-1] - sight.times[0]) / (_MOST_KEYS - 1))
    keys = sight.at(spaced(sight.times, spacing))
    count = keys.seen.sum(axis=0)
    points = np.argsort(-count, kind="stable")[:_MOST_POINTS]
    return keys.of(points[count[points] >= 3])


def window_state(
    path: Path, alignment: Alignment, geometry: Geometry, R: Array, delta_v: Array, gyro_bias: Array
) -> WindowState:
    """The linear solution in a world whose z axis is up, as unknowns of the bundle adjustment."""
    sight = geometry.sight
    times = (sight.times - sight.times[0])[:, None]
    R_world_first = level(-alignment.gravity)
    lever = geometry.T_body_cams[0][:3, 3]
    scale = 1.0 if path.metric else alignment.scale
    apart = 0.0 if path.metric else R @ lever - lever
    places = scale * path.places - apart
    velocity = alignment.velocity + alignment.gravity * times + np.concatenate([np.zeros((1, 3)), delta_v])
    # Points in the frame of the first view, whose origin is the camera, or the body where the path is metric.
    origin = 0.0 if path.metric else lever
    points = scale * path.points + origin
    anchor = np.argmax(sight.seen, axis=0)
    centres = places + R @ lever
    distance = np.linalg.norm(points - centres[anchor], axis=1)
    return WindowState(
        R=R_world_first @ R,
        p=places @ R_world_first.T,
        v=velocity @ R_world_first.T,
        bias=ImuBias(gyro=gyro_bias, accel=alignment.accel_bias),
        delay_s=0.0,
        inverse_depth=1.0 / np.clip(np.nan_to_num(distance, nan=10.0), 0.2, 400.0),
    )


def sightings_of(geometry: Geometry, sigma: float, usable: Mask) -> Sightings:
    """The rays of the keyframes as the bundle adjustment takes them.

    Args:
        geometry: keyframes.
        sigma: rad, of a ray.
        usable: (M,) points that have a depth.
    """
    sight = geometry.sight
    K = len(sight.times)
    anchor = np.argmax(sight.seen, axis=0)
    seen = sight.seen & usable
    seen[anchor, np.arange(len(anchor))] = False
    view, point = np.nonzero(seen)
    view_right, point_right = np.nonzero(sight.seen_stereo & usable)
    cams = geometry.T_body_cams
    T = np.concatenate([np.tile(cams[0], (K, 1, 1)), np.tile(cams[-1], (K, 1, 1))])
    if len(cams) == 1:
        view_right, point_right = view_right[:0], point_right[:0]
    return Sightings(
        point=np.concatenate([point, point_right]),
        view=np.concatenate([view, view_right + K]),
        anchor=anchor,
        ray=np.concatenate([sight.bearings[view, point], sight.stereo[view_right, point_right]]),
        anchor_ray=sight.bearings[anchor, np.arange(len(anchor))],
        instant=np.tile(np.arange(K), 2),
        R_body_cam=T[:, :3, :3],
        p_body_cam=T[:, :3, 3],
        sigma=sigma,
    )


def views_of(geometry: Geometry, R: Array) -> Views:
    """What the keyframes see, in the body at the first instant; with both cameras where there are two.

    Args:
        geometry: keyframes.
        R: (K, 3, 3) rotations of the body at the keyframes to the first one.
    """
    sight = geometry.sight
    sources = ((sight.bearings, sight.seen), (sight.stereo, sight.seen_stereo))
    cams = list(zip(sources, geometry.T_body_cams, strict=False))
    return Views(
        instants=np.tile(np.arange(len(R)), len(cams)),
        direction=np.concatenate([rays @ T[:3, :3].T @ R.swapaxes(-1, -2) for (rays, _), T in cams]),
        seen=np.concatenate([seen for (_, seen), _ in cams]),
        lever=np.concatenate([R @ T[:3, 3] for _, T in cams]),
        metric=len(cams) > 1,
    )
