"""Views of the simulator's rooms, halls, corridors and streets from anywhere in them."""

from collections.abc import Sequence

import numpy as np

from vioframe.checks import Array, check_positive
from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.families import plan_motion
from vioframe.data.simulator.imaging import build_world
from vioframe.data.simulator.plan import PlannedMotion, rotation_from_angles
from vioframe.data.simulator.render import Renderer
from vioframe.data.simulator.texture import Atlas, to_grey
from vioframe.data.simulator.world import World
from vioframe.pictures.lighting import change_light
from vioframe.pictures.sources import COMMON_LIGHT, TRIES, Purpose, check_size, shows_something
from vioframe.types import Camera, Image

# Streets are cheap to build and differ most.
_FAMILIES = ("walk", "car", "drone", "car", "corridor")
_DURATION_S = 20.0
_CLEARANCE_M = 0.3
_TRIES = 30
_FOCAL_LENGTHS = (0.5, 0.75, 1.1)
# Tags that keep the random numbers of one purpose apart from those of the others.
_TAGS: dict[Purpose, int] = {"training": 76, "held_out": 77, "validation": 80}
# The simulator's seeds of training, validation and test lie far below.
_FIRST_WORLD = 5_000_000
# Body axes x forward, y left, z up into the camera's x right, y down, z forward.
_R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class RenderedPlaces:
    """Pictures drawn in simulated places, a number of them in each, one place after the other.

    The last place asked for is kept, since building one takes about a second: ask in order.

    Args:
        size_px: (width, height).
        count: how many.
        seed: of all.
        each: pictures in a place.
        purpose: what they are for.
    """

    def __init__(
        self, *, size_px: Sequence[int], count: int, seed: int = 0, each: int = 80, purpose: Purpose = "training"
    ) -> None:
        check_positive("pictures", count=count, each=each)
        self._size_px = check_size("pictures", size_px)
        self._count = count
        self._seed = seed
        self._each = each
        self._tag = _TAGS[purpose]
        self._place: _Place | None = None

    def __len__(self) -> int:
        """How many there are."""
        return self._count

    def picture(self, index: int) -> Image:
        """Picture ``index`` (H, W) uint8."""
        number = index // self._each
        if self._place is None or self._place.number != number:
            world_seed = int(np.random.default_rng([self._seed, self._tag, number]).integers(2**31)) + _FIRST_WORLD
            self._place = _Place(number, world_seed, self._size_px)
        for attempt in range(TRIES):
            rng = np.random.default_rng([self._seed, self._tag, number, index, attempt])
            view = self._place.view(rng)
            if shows_something(view):
                break
        return change_light(view, rng, COMMON_LIGHT)


class _Place:
    """One world, and cameras of a few focal lengths in it."""

    def __init__(self, number: int, seed: int, size_px: tuple[int, int]) -> None:
        self.number = number
        family = _FAMILIES[number % len(_FAMILIES)]
        plan: PlannedMotion = plan_motion(family, seed, _DURATION_S, 0.0)
        built = build_world(plan, seed, _DURATION_S, Degradations())
        self._world = World(built)
        atlas = Atlas(built.textures)
        self._outdoors = plan.place == "street"
        self._motion = plan.motion
        width, height = size_px
        self._renderers = [
            Renderer(
                self._world,
                atlas,
                Camera(
                    model="pinhole",
                    intrinsics_px=np.array([share * width, share * width, 0.5 * (width - 1), 0.5 * (height - 1)]),
                    size_px=size_px,
                    T_body_cam=np.eye(4),
                ),
            )
            for share in _FOCAL_LENGTHS
        ]

    def view(self, rng: np.random.Generator) -> Image:
        """What a camera sees somewhere here, brought to a common exposure, (H, W) uint8."""
        renderer = self._renderers[int(rng.integers(len(self._renderers)))]
        grey = renderer.render(self._pose(rng)).grey
        # Towards a mean that an automatic exposure would reach.
        gain = rng.uniform(80.0, 160.0) / max(float(grey.mean()), 10.0)
        return to_grey(grey * np.float32(np.clip(gain, 0.5, 2.0)))

    def _pose(self, rng: np.random.Generator) -> Array:
        """T_world_cam (4, 4) in free space near the path that the place was built around."""
        pose = np.eye(4)
        spread = np.array([1.0, 1.0, 0.4]) if self._outdoors else np.array([0.8, 0.6, 0.5])
        for _ in range(_TRIES):
            body = self._motion.evaluate(rng.uniform(0.0, _DURATION_S)).T_world_body
            pose[:3, 3] = body[:3, 3] + spread * rng.standard_normal(3)
            if self._world.clearance(pose[None, :3, 3])[0] > _CLEARANCE_M:
                break
        else:
            pose[:3, 3] = body[:3, 3]
        ahead = np.arctan2(body[1, 0], body[0, 0])
        yaw = ahead + rng.normal(0.0, 0.6) if self._outdoors else rng.uniform(-np.pi, np.pi)
        pitch, roll = rng.normal(-0.05 if self._outdoors else 0.05, 0.22), rng.normal(0.0, 0.2)
        turn = rotation_from_angles(np.array([yaw]), np.array([pitch]), np.array([roll]))[0]
        pose[:3, :3] = turn @ _R_BODY_CAM
        return pose
