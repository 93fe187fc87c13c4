"""Loop closure by looks: bags of words find a place, points prove it, a pose graph draws the conclusion."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ConfigError, DataError, StateError
from vioframe.geometry import se3, so3
from vioframe.types import SensorRig, Trajectory
from vioframe_window import loop_graph as graph
from vioframe_window.loop_appearance import Appearance, Describer
from vioframe_window.loop_geometry import Found, locate
from vioframe_window.loop_interface import LoopCloser, LoopKeyframe, LoopMatch
from vioframe_window.loop_map import PlaceMap, load_map, save_map
from vioframe_window.loop_options import GraphOptions, Retrieval, Verification
from vioframe_window.loop_points import RecentPoints
from vioframe_window.loop_trajectory import KeyframeTrajectory
from vioframe_window.loop_vocabulary import PlaceIndex

log = logging.getLogger(__name__)

# Two matches in a row must agree before a sequence is moved into a loaded map: by this much, within this time.
_AGREE_M, _AGREE_RAD = 0.5, np.radians(4.0)
_AGREE_WITHIN_NS = 5 * NANOSECONDS
# Keyframes from which the points of a keyframe are triangulated: about two seconds.
_RECENT_KEYFRAMES = 10
# Yaw that an odometry may have lost at worst.
_YAW_DRIFT = np.radians(30.0)
# Keyframes on both sides of a candidate that show the same place.
_SAME_PLACE_KEYFRAMES = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Place:
    """A remembered keyframe: its number in the trajectory, its stamp and what it looks like."""

    node: int
    stamp_ns: int
    appearance: Appearance


class BowLoop(LoopCloser):
    """Bags of binary words with a vocabulary grown online, PnP, and a pose graph over yaw and position.

    Args:
        retrieval: which keyframes are remembered and compared.
        verification: what makes a candidate a match.
        graph: pose graph.
        load_map: file of a map to start in, or None.
        save_map: file to write the map to in the end, or None.

    Raises:
        ConfigError: the folder for the map does not exist.
    """

    def __init__(
        self,
        *,
        retrieval: Retrieval | None = None,
        verification: Verification | None = None,
        graph: GraphOptions | None = None,
        load_map: str | None = None,
        save_map: str | None = None,
    ) -> None:
        self._retrieval = retrieval or Retrieval()
        self._verification = verification or Verification()
        self._graph = graph or GraphOptions()
        self._load_from = None if load_map is None else Path(load_map)
        self._save_to = None if save_map is None else Path(save_map)
        if self._save_to is not None and not self._save_to.absolute().parent.is_dir():
            raise ConfigError(f"loop.save_map={save_map}: there is no folder {self._save_to.absolute().parent}")
        self._trajectory: KeyframeTrajectory | None = None

    def setup(self, rig: SensorRig) -> None:
        """Forget the last sequence and take the next one's calibration; load the map to start in, if any."""
        if not rig.cameras:
            raise DataError("loop=bow needs a camera, and this rig has none: choose loop=none")
        graph.load_solver()
        options = self._retrieval
        self._camera = rig.cameras[0]
        self._focal_px = float(self._camera.intrinsics_px[:2].mean())
        self._describer = Describer(
            self._camera, corners=options.corners, threshold=options.threshold, cell_px=options.cell_px
        )
        self._index = PlaceIndex(branching=options.branching, capacity=options.leaf_capacity)
        self._recent = RecentPoints(keyframes=_RECENT_KEYFRAMES, focal_px=self._focal_px)
        self._places: list[_Place] = []
        given = None if self._load_from is None else load_map(self._load_from, self._camera)
        self._trajectory = KeyframeTrajectory(self._graph, None if given is None else given.T_map_body)
        self._counts: dict[str, int] = {}
        self._interrupted = False
        self._refinable: set[int] = set()
        self._pending: tuple[int, float, Array] | None = None
        if given is not None:
            for node, (stamp_ns, seen) in enumerate(zip(given.stamps_ns.tolist(), given.appearances, strict=True)):
                self._index.add(seen.descriptors)
                self._places.append(_Place(node=node, stamp_ns=stamp_ns, appearance=seen))

    def add_keyframe(self, keyframe: LoopKeyframe) -> LoopMatch | None:
        """Take the next keyframe; a match, if it sees a known place, is already part of the correction."""
        trajectory = self._ready()
        T_body_cam = self._camera.T_body_cam if keyframe.T_body_cam is None else keyframe.T_body_cam
        self._recent.push(keyframe, T_body_cam)
        if self._is_near_the_last(keyframe.T_world_body):
            return None
        down_cam = -(keyframe.T_world_body[:3, :3] @ T_body_cam[:3, :3])[2]
        seen = self._describer.describe(keyframe.image, keyframe.tracks, down_cam, keyframe.untracked)
        node = trajectory.add(keyframe.stamp_ns, keyframe.T_world_body, broken=self._interrupted)
        self._interrupted = False
        match = self._find(keyframe, T_body_cam, seen, node)
        self._index.add(seen.descriptors)
        self._places.append(_Place(node=node, stamp_ns=keyframe.stamp_ns, appearance=seen))
        self._count("loop keyframes")
        if len(self._places) > self._retrieval.most:
            self._thin()
        return match

    def settle(self, stamps_ns: Stamps, T_world_body: Array) -> None:
        """Take better estimates (N, 4, 4), in the odometry frame, of keyframes added before; unknown stamps pass."""
        self._ready().settle(stamps_ns, T_world_body)
        self._recent.settle(stamps_ns, T_world_body)

    def refine(self, match_id: int, T_world_loop: Array, T_world_body: Array) -> None:
        """Take a better relative pose of a match; it passes where most points of the match were not the smoother's."""
        if match_id in self._refinable:
            self._ready().refine(match_id, se3.inverse(T_world_loop) @ T_world_body)

    def interrupt(self) -> None:
        """The smoother started again: the step from the last keyframe to the next is not to be trusted."""
        self._interrupted = True
        self._recent.forget()

    @property
    def T_map_world(self) -> Array:
        """Correction (4, 4), yaw and position only, of the present odometry frame."""
        return self._ready().T_map_world

    def correct(self, trajectory: Trajectory) -> Trajectory:
        """The final trajectory, in the map (``causal=False``), of one in the odometry frame."""
        keyframes = self._ready()
        keyframes.solve()
        T_map_world = keyframes.correction_at(trajectory.stamps_ns)
        velocity = trajectory.v_world_body
        if velocity is not None:
            velocity = (T_map_world[:, :3, :3] @ velocity[..., None])[..., 0]
        return Trajectory(
            stamps_ns=trajectory.stamps_ns,
            T_world_body=T_map_world @ trajectory.T_world_body,
            v_world_body=velocity,
            causal=False,
        )

    def finish(self) -> None:
        """The recording has ended: save the map, where this is wanted."""
        trajectory = self._ready()
        trajectory.solve()
        if self._save_to is None:
            return
        # Keyframes that were never found in the loaded map have no place in it.
        kept = [place for place in self._places if place.node < trajectory.first or trajectory.is_in_map]
        if len(kept) < len(self._places):
            log.warning(
                "loop.save_map=%s: this sequence was not found in the loaded map, which is saved as it was",
                self._save_to,
            )
        if not kept:
            log.warning("loop.save_map=%s: there is no keyframe to save", self._save_to)
            return
        places = PlaceMap(
            stamps_ns=np.array([place.stamp_ns for place in kept], dtype=np.int64),
            T_map_body=trajectory.T_map_body[[place.node for place in kept]],
            appearances=tuple(place.appearance for place in kept),
        )
        save_map(self._save_to, places, self._camera)

    def counters(self) -> Mapping[str, int]:
        """Keyframes remembered, loop closures, and candidates that were refused."""
        return dict(self._counts)

    def _ready(self) -> KeyframeTrajectory:
        if self._trajectory is None:
            raise StateError("BowLoop was used before setup(rig): set the loop closer up first")
        return self._trajectory

    def _is_near_the_last(self, T_world_body: Array) -> bool:
        trajectory = self._ready()
        if len(trajectory) == trajectory.first or self._interrupted:
            return False
        motion = se3.inverse(trajectory.T_world_body[-1]) @ T_world_body
        moved = float(np.linalg.norm(motion[:3, 3])) >= self._retrieval.spacing_m
        turned = float(so3.angle(motion[:3, :3])) >= np.radians(self._retrieval.spacing_deg)
        return not (moved or turned)

    def _find(self, keyframe: LoopKeyframe, T_body_cam: Array, seen: Appearance, node: int) -> LoopMatch | None:
        """A remembered keyframe that sees the same place, or None."""
        candidates = self._candidates(keyframe.stamp_ns, seen)
        if not candidates:
            return None
        ids, points_world = self._recent.seen_now(keyframe)
        ids, corners, rows = np.intersect1d(seen.ids, ids, return_indices=True)
        # Around the body, so that the far end of a long walk is no worse than its beginning.
        points = se3.transform(se3.inverse(keyframe.T_world_body), points_world[rows])
        for number in candidates:
            place = self._places[number]
            self._count("loop candidates")
            found = locate(
                points, seen.descriptors[corners], place.appearance, self._focal_px, self._verification, seed=node
            )
            if found is None:
                continue
            T_body_loop = found.T_points_cam @ se3.inverse(T_body_cam)
            if not self._is_plausible(place, keyframe, keyframe.T_world_body @ T_body_loop, node):
                self._count("loop candidates refused")
                continue
            return self._close(place, keyframe, T_body_loop, found, ids, node)
        return None

    def _candidates(self, stamp_ns: int, seen: Appearance) -> list[int]:
        """Places that look most like a new keyframe, the likeliest first, one of each neighbourhood."""
        options = self._retrieval
        first = self._ready().first
        similarity = self._index.similarity(seen.descriptors)
        if not len(similarity):
            return []
        before = similarity[-1] if self._places[-1].node >= first else similarity.max()
        youngest_ns = stamp_ns - round(options.exclude_s * NANOSECONDS)
        node = np.array([place.node for place in self._places])
        old = np.array([place.stamp_ns for place in self._places]) <= youngest_ns
        similarity = np.where((old | (node < first)) & self._is_in_reach()[node], similarity, 0.0)
        chosen: list[int] = []
        while len(chosen) < options.candidates:
            best = int(similarity.argmax())
            if similarity[best] <= options.min_similarity * before:
                break
            chosen.append(best)
            similarity[max(best - _SAME_PLACE_KEYFRAMES, 0) : best + _SAME_PLACE_KEYFRAMES + 1] = 0.0
        return chosen

    def _is_in_reach(self) -> np.ndarray:
        """Whether the newest keyframe may see what each keyframe (N,) saw, wherever the odometry has drifted to."""
        options, trajectory = self._verification, self._ready()
        if not trajectory.is_in_map:
            return np.ones(len(trajectory), dtype=bool)
        distance, turn = trajectory.apart_from_newest()
        drift_m = options.max_drift_m + options.max_drift * trajectory.ways()
        reach: np.ndarray = distance < options.max_distance_m + drift_m
        reach &= turn < np.radians(options.max_yaw_deg) + _YAW_DRIFT
        return reach

    def _is_plausible(self, place: _Place, keyframe: LoopKeyframe, T_world_loop: Array, node: int) -> bool:
        """Whether gravity, the distance of the views and the drift of the odometry allow a match."""
        options, trajectory = self._verification, self._ready()
        own = trajectory.T_world_body[place.node]
        tilt = np.arccos(np.clip(own[2, :3] @ T_world_loop[2, :3], -1.0, 1.0))
        motion = se3.inverse(T_world_loop) @ keyframe.T_world_body
        turn = graph.yaw_of(keyframe.T_world_body[:3, :3] @ T_world_loop[:3, :3].T)
        if (
            tilt > np.radians(options.max_tilt_deg)
            or abs(turn) > np.radians(options.max_yaw_deg)
            or np.linalg.norm(motion[:3, 3]) > options.max_distance_m
        ):
            return False
        yaw, offset = trajectory.implied_correction(place.node, se3.inverse(T_world_loop))
        if place.node < trajectory.first and not trajectory.is_in_map:
            return self._is_confirmed(keyframe.stamp_ns, yaw, offset, keyframe.T_world_body[:3, 3])
        here = so3.rotation_z(yaw) @ keyframe.T_world_body[:3, 3] + offset
        moved = np.linalg.norm(here - trajectory.T_map_body[node][:3, 3])
        return bool(moved <= options.max_drift_m + options.max_drift * trajectory.ways()[place.node])

    def _is_confirmed(self, stamp_ns: int, yaw: float, offset: Array, position: Array) -> bool:
        """Whether the last match with the loaded map said the same about where this sequence lies in it."""
        pending = self._pending
        if pending is not None and pending[0] == stamp_ns:
            # Its neighbours in the map say the same of the same image: that is no second opinion.
            return False
        self._pending = stamp_ns, yaw, offset
        if pending is None or stamp_ns - pending[0] > _AGREE_WITHIN_NS:
            return False
        apart = (so3.rotation_z(yaw) - so3.rotation_z(pending[1])) @ position + offset - pending[2]
        turned = float(graph.wrap(np.array(yaw - pending[1])))
        return bool(np.linalg.norm(apart) < _AGREE_M and abs(turned) < _AGREE_RAD)

    def _close(
        self, place: _Place, keyframe: LoopKeyframe, T_body_loop: Array, found: Found, ids: Stamps, node: int
    ) -> LoopMatch:
        trajectory = self._ready()
        T_world_loop = keyframe.T_world_body @ T_body_loop
        if place.node < trajectory.first and not trajectory.is_in_map:
            trajectory.move_into_map(*trajectory.implied_correction(place.node, se3.inverse(T_world_loop)))
        number = trajectory.match(
            place.node, node, se3.inverse(T_body_loop), sigma_rad=found.sigma_rad, sigma_m=found.sigma_m
        )
        self._count("loop closures")
        held = np.isin(ids[found.points], keyframe.landmark_ids)
        points, corners = found.points[held], found.corners[held]
        if 2 * len(points) > len(found.points):
            self._refinable.add(number)
        return LoopMatch(
            match_id=number,
            stamp_ns=keyframe.stamp_ns,
            loop_stamp_ns=place.stamp_ns,
            T_world_loop=T_world_loop,
            landmark_ids=ids[points],
            pixels=place.appearance.pixels[corners],
            bearings=place.appearance.bearings[corners],
        )

    def _thin(self) -> None:
        """Forget every second of the older half of the places."""
        count = len(self._places)
        kept = np.ones(count, dtype=bool)
        kept[1 : count // 2 : 2] = False
        self._index.thin(kept)
        self._places = [place for place, keep in zip(self._places, kept.tolist(), strict=True) if keep]
        wanted = np.zeros(len(self._ready()), dtype=bool)
        wanted[[place.node for place in self._places]] = True
        number = self._ready().thin(wanted)
        self._places = [
            _Place(node=int(number[place.node]), stamp_ns=place.stamp_ns, appearance=place.appearance)
            for place in self._places
        ]

    def _count(self, what: str) -> None:
        self._counts[what] = self._counts.get(what, 0) + 1
