"""The last seconds of measurements that a start in motion looks at."""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.conventions import NANOSECONDS, seconds
from vioframe.tight.inertial_window import InertialWindow
from vioframe.types import Measurement, Tracks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """Points that images of one window see.

    Attributes:
        times: (K,) s, of the images, from the oldest image of the window.
        bearings: (K, M, 3) unit vectors in camera 0, zero where unseen.
        seen: (K, M).
        stereo: (K, M, 3) unit vectors in camera 1, zero where unseen.
        seen_stereo: (K, M).
    """

    times: Array
    bearings: Array
    seen: Mask
    stereo: Array
    seen_stereo: Mask

    def of(self, points: Stamps) -> "Sight":
        """These points (indices) only."""
        return replace(
            self,
            bearings=self.bearings[:, points],
            seen=self.seen[:, points],
            stereo=self.stereo[:, points],
            seen_stereo=self.seen_stereo[:, points],
        )

    def at(self, images: Stamps) -> "Sight":
        """These images (indices) only."""
        return Sight(
            times=self.times[images],
            bearings=self.bearings[images],
            seen=self.seen[images],
            stereo=self.stereo[images],
            seen_stereo=self.seen_stereo[images],
        )


class MotionWindow:
    """Keeps measurements without their pixels, for a limited time.

    Args:
        longest_s: what is older than this is forgotten, s.
    """

    def __init__(self, longest_s: float) -> None:
        self._longest_ns = round(longest_s * NANOSECONDS)
        self._kept: deque[Measurement] = deque()

    def __len__(self) -> int:
        return len(self._kept)

    def push(self, measurement: Measurement) -> None:
        """Take the next measurement; one that does not follow the last forgets what came before."""
        if self._kept and self._kept[-1].window.current.stamp_ns != measurement.window.previous.stamp_ns:
            self._kept.clear()
        self._kept.append(_without_images(measurement))
        while self._kept[0].window.current.stamp_ns < measurement.window.current.stamp_ns - self._longest_ns:
            self._kept.popleft()

    def clear(self) -> None:
        """Forget everything."""
        self._kept.clear()

    @property
    def span_s(self) -> float:
        """Seconds from the oldest image to the newest."""
        if not self._kept:
            return 0.0
        return seconds(self._kept[-1].window.current.stamp_ns - self._kept[0].window.current.stamp_ns)

    @property
    def origin_ns(self) -> int:
        """Stamp of the oldest image."""
        return self._kept[0].window.current.stamp_ns

    @property
    def after_origin(self) -> tuple[Measurement, ...]:
        """The measurements after the oldest image, oldest first."""
        return tuple(self._kept)[1:]

    def inertial(self) -> InertialWindow:
        """The samples from the start of the oldest window on; seconds count from the oldest image."""
        return InertialWindow([kept.window.imu for kept in self._kept], self.origin_ns)

    def sight(self) -> Sight:
        """All points of all images."""
        tracks = [_tracks(kept) for kept in self._kept]
        stereo = [_stereo(kept) for kept in self._kept]
        ids = np.unique(np.concatenate([each.ids for each in tracks]))
        stamps_ns: Stamps = np.array([kept.window.current.stamp_ns for kept in self._kept])
        bearings, seen = _stacked(tracks, ids)
        right, seen_right = _stacked(stereo, ids)
        return Sight(
            times=(stamps_ns - self.origin_ns) / NANOSECONDS,
            bearings=bearings,
            seen=seen,
            stereo=right,
            seen_stereo=seen_right,
        )


def _without_images(measurement: Measurement) -> Measurement:
    """A copy that holds no pixels: a window of seconds is kept, and it must stay small."""
    window, features = measurement.window, measurement.features
    bare = replace(window, previous=replace(window.previous, images=()), current=replace(window.current, images=()))
    if features is not None:
        features = replace(features, frame=bare.current, flow=None)
    return replace(measurement, window=bare, features=features)


def _tracks(measurement: Measurement) -> Tracks:
    features = measurement.features
    return Tracks.none() if features is None or features.tracks is None else features.tracks


def _stereo(measurement: Measurement) -> Tracks:
    features = measurement.features
    return Tracks.none(camera=1) if features is None or features.stereo is None else features.stereo


def _stacked(tracks: list[Tracks], ids: Stamps) -> tuple[Array, Mask]:
    bearings = np.zeros((len(tracks), len(ids), 3))
    seen = np.zeros((len(tracks), len(ids)), dtype=bool)
    for row, each in enumerate(tracks):
        at = np.searchsorted(ids, each.ids)
        bearings[row, at] = each.bearings
        seen[row, at] = True
    return bearings, seen
