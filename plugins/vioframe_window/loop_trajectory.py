"""The remembered keyframes in both frames: the odometry's poses, the matches between them, and the correction."""

from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.geometry import se3, so3
from vioframe_window import loop_graph as graph
from vioframe_window.loop_options import GraphOptions

# Points that are a little wrong together, as triangulated ones are, are worse than the scatter of their corners tells.
_CAUTION = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Match:
    """A keyframe seen from another.

    Attributes:
        start, end: nodes.
        T_start_end: (4, 4) pose of the later body in the frame of the earlier.
        sigmas: (2,) rad and m an axis.
    """

    start: int
    end: int
    T_start_end: Array
    sigmas: Array


class KeyframeTrajectory:
    """Keyframes of a loaded map, which stay where they are, and those of this sequence after them.

    The correction of a keyframe is a yaw ψ and an offset t: its pose in the map is ``(Rz(ψ) R, Rz(ψ) o + t)``.

    Args:
        options: of the pose graph.
        T_map_body: (K, 4, 4) keyframes of a loaded map.
    """

    def __init__(self, options: GraphOptions, T_map_body: Array | None = None) -> None:
        self._options = options
        given = np.zeros((0, 4, 4)) if T_map_body is None else T_map_body
        self.first = len(given)
        self.stamps_ns = np.zeros(self.first, dtype=np.int64)
        self.T_world_body = given
        self._yaw: Array = np.zeros(self.first)
        self._offset: Array = np.zeros((self.first, 3))
        self._broken = np.zeros(self.first, dtype=bool)
        self._order = np.zeros(self.first, dtype=np.int64)
        self._added = 0
        self._matches: dict[int, Match] = {}
        self._next_match = 0
        self._stale = False
        self.is_in_map = self.first == 0

    def __len__(self) -> int:
        return len(self.T_world_body)

    @property
    def T_map_world(self) -> Array:
        """Correction (4, 4) of the newest keyframe."""
        if len(self) == self.first:
            return np.eye(4)
        return se3.from_parts(so3.rotation_z(self._yaw[-1]), self._offset[-1])

    @property
    def T_map_body(self) -> Array:
        """(N, 4, 4), of all keyframes."""
        T_map_world = se3.from_parts(so3.rotation_z(self._yaw), self._offset)
        corrected: Array = T_map_world @ self.T_world_body
        return corrected

    def add(self, stamp_ns: int, T_world_body: Array, *, broken: bool) -> int:
        """Number of the next keyframe; ``broken`` where the odometry did not measure the step to it."""
        T_map_world = self._yaw[-1:], self._offset[-1:]
        if len(self) == self.first:
            T_map_world = np.zeros(1), np.zeros((1, 3))
        self.stamps_ns = np.append(self.stamps_ns, stamp_ns)
        self.T_world_body = np.concatenate([self.T_world_body, T_world_body[None]])
        self._yaw = np.concatenate([self._yaw, T_map_world[0]])
        self._offset = np.concatenate([self._offset, T_map_world[1]])
        self._broken = np.append(self._broken, broken)
        self._order = np.append(self._order, self._added)
        self._added += 1
        return len(self) - 1

    def settle(self, stamps_ns: Stamps, T_world_body: Array) -> None:
        """Take better odometry poses (M, 4, 4) of keyframes of this sequence; unknown stamps pass."""
        own = self.stamps_ns[self.first :]
        if not len(own):
            return
        rows = np.minimum(np.searchsorted(own, stamps_ns), len(own) - 1)
        known = own[rows] == stamps_ns
        self.T_world_body[self.first + rows[known]] = T_world_body[known]

    def ways(self) -> Array:
        """Metres of odometry (N,) from each keyframe to the newest; from a map's, since the sequence began."""
        own = self.T_world_body[self.first :, :3, 3]
        steps = np.linalg.norm(np.diff(own, axis=0), axis=1)
        ahead = np.concatenate([np.cumsum(steps[::-1])[::-1], np.zeros(min(len(own), 1))])
        return np.concatenate([np.full(self.first, ahead[0] if len(ahead) else 0.0), ahead])

    def apart_from_newest(self) -> tuple[Array, Array]:
        """Distance (N,) m in the map, and turn (N,) rad about gravity, of each keyframe from the newest."""
        T_map_body = self.T_map_body
        distance = np.linalg.norm(T_map_body[:, :3, 3] - T_map_body[-1, :3, 3], axis=1)
        return distance, np.abs(graph.yaw_of(T_map_body[:, :3, :3] @ T_map_body[-1, :3, :3].T))

    def implied_correction(self, start: int, T_start_world: Array) -> tuple[float, Array]:
        """Yaw and offset that the present odometry frame would have if it lay at (4, 4) in the body ``start``."""
        T_map_start = self.T_map_body[start]
        T_map_world = T_map_start @ T_start_world
        yaw = float(graph.yaw_of(T_map_world[:3, :3]))
        # Yaw only, about the old body, whose place is what is known.
        at_world = se3.inverse(T_start_world)[:3, 3]
        return yaw, T_map_start[:3, 3] - so3.rotation_z(yaw) @ at_world

    def move_into_map(self, yaw: float, offset: Array) -> None:
        """Give every keyframe of this sequence one correction: where it was in the map was not known before."""
        turn = so3.rotation_z(yaw)
        self._yaw[self.first :] += yaw
        self._offset[self.first :] = self._offset[self.first :] @ turn.T + offset
        self.is_in_map = True

    def match(self, start: int, end: int, T_start_end: Array, *, sigma_rad: float = 0.0, sigma_m: float = 0.0) -> int:
        """Number of a new match, which the correction takes into account at once where it is off.

        Args:
            start, end: keyframes.
            T_start_end: (4, 4).
            sigma_rad, sigma_m: of it, an axis, which the options' are added to.
        """
        number = self._next_match
        self._next_match += 1
        least = np.array([np.radians(self._options.match_sigma_yaw_deg), self._options.match_sigma_m])
        sigmas = np.hypot(least, _CAUTION * np.array([sigma_rad, sigma_m]))
        self._matches[number] = Match(start=start, end=end, T_start_end=T_start_end, sigmas=sigmas)
        self._take(number)
        return number

    def refine(self, number: int, T_start_end: Array) -> None:
        """Replace the pose of a match; one that has been forgotten passes."""
        if number in self._matches:
            self._matches[number] = replace(self._matches[number], T_start_end=T_start_end)
            self._take(number)

    def _take(self, number: int) -> None:
        error = graph.errors(self._yaw, self.T_map_body[:, :3, 3], self._match_edges([self._matches[number]]))
        self._stale = True
        if np.linalg.norm(error) > self._options.solve_above:
            self.solve()

    def solve(self) -> None:
        """Bring the correction up to date with odometry and matches."""
        if not self._stale or not self._matches:
            return
        self._stale = False
        matches = list(self._matches.values())
        earliest = min(match.start for match in matches)
        own = slice(self.first, None)
        edges = graph.odometry_edges(self.T_world_body[own], self._order[own], self._broken[own], self._options)
        edges = graph.Edges.join(edges.shifted(self.first), self._match_edges(matches))
        fixed = np.arange(len(self)) < self.first
        if earliest >= self.first:
            # Nothing tells on the keyframes before the first that was seen again.
            fixed = np.arange(len(self)) <= earliest
        yaw, position = graph.solve(self._yaw, self.T_map_body[:, :3, 3], fixed, edges, self._options)
        self._yaw = yaw
        turned = so3.rotation_z(yaw) @ self.T_world_body[:, :3, 3:]
        self._offset = position - turned[..., 0]

    def _match_edges(self, matches: list[Match]) -> graph.Edges:
        return graph.match_edges(
            np.array([match.start for match in matches]),
            np.array([match.end for match in matches]),
            np.array([match.T_start_end for match in matches]),
            np.array([match.sigmas for match in matches]),
            self.T_world_body[:, :3, :3],
        )

    def correction_at(self, stamps_ns: Stamps) -> Array:
        """T_map_world (M, 4, 4) at stamps, between keyframes in between; the ends hold on."""
        if len(self) == self.first:
            return np.tile(np.eye(4), (len(stamps_ns), 1, 1))
        own = slice(self.first, None)
        # Stamps as float64 would be off by a hundred nanoseconds; from the first keyframe they are exact.
        begin = self.stamps_ns[self.first]
        at, known = (stamps_ns - begin).astype(float), (self.stamps_ns[own] - begin).astype(float)
        yaw = np.interp(at, known, np.unwrap(self._yaw[own]))
        offset = np.stack([np.interp(at, known, self._offset[own, axis]) for axis in range(3)], axis=1)
        return se3.from_parts(so3.rotation_z(yaw), offset)

    def thin(self, wanted: np.ndarray) -> np.ndarray:
        """Forget keyframes that are neither ``wanted`` (N,) bool nor matched; numbers (N,) now, −1 if forgotten."""
        kept = wanted.copy()
        kept[-self._options.neighbours - 1 :] = True
        for match in self._matches.values():
            kept[[match.start, match.end]] = True
        number = np.where(kept, np.cumsum(kept) - 1, -1)
        breaks = np.cumsum(self._broken)[kept]
        self._broken = np.diff(breaks, prepend=0) > 0
        self.first = int(kept[: self.first].sum())
        self.stamps_ns, self.T_world_body = self.stamps_ns[kept], self.T_world_body[kept]
        self._yaw, self._offset, self._order = self._yaw[kept], self._offset[kept], self._order[kept]
        self._matches = {
            key: replace(m, start=int(number[m.start]), end=int(number[m.end])) for key, m in self._matches.items()
        }
        return number
