"""From an instant to the images of the rig: the world, the light, the shutter and the sensor."""

import math
from collections.abc import Sequence

import numpy as np

from vioframe.checks import Array, Mask
from vioframe.data.simulator.building import build_building
from vioframe.data.simulator.cameras import CameraSettings
from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.drive import BODY_HEIGHT_M
from vioframe.data.simulator.flow import Sight, exact_flow
from vioframe.data.simulator.plan import PlannedMotion
from vioframe.data.simulator.render import Renderer, View
from vioframe.data.simulator.rooms import PATH_STEP_S, build_room
from vioframe.data.simulator.street import build_street
from vioframe.data.simulator.texture import Atlas
from vioframe.data.simulator.world import World, WorldPlan
from vioframe.geometry import se3, so3
from vioframe.types import Camera

# Photo-electrons of a full pixel, and noise of the read-out in grey values, of a small global-shutter sensor at
# high gain: they set how much noise low light brings.
_FULL_WELL = 2000.0
_READ_NOISE_DN = 1.5
# An exposure is averaged in steps of at most so many pixels, of a scene at this distance; a picture is smooth enough
# for that, and fewer steps would show as ghosts of its edges. What moves by itself is not known beforehand.
_BLUR_STEP_PX = 2.0
_BLUR_DISTANCE_M = 2.0
_BLUR_MOST = 16
_BLUR_OF_OBJECTS = 7


def build_world(plan: PlannedMotion, seed: int, duration_s: float, degradations: Degradations) -> WorldPlan:
    """The place a motion needs, always the same for the same seed."""
    rng = np.random.default_rng([seed, 20])
    times = np.arange(0.0, duration_s + PATH_STEP_S, PATH_STEP_S)
    path = plan.motion.evaluate(times).T_world_body[:, :3, 3]
    if plan.place == "street":
        return build_street(
            rng,
            path,
            camera_height_m=BODY_HEIGHT_M,
            contrast=1.0 - degradations.low_texture,
            moving=int(degradations.moving_objects),
        )
    if plan.place == "building":
        return build_building(
            rng,
            path,
            path if plan.route is None else plan.route,
            contrast=1.0 - degradations.low_texture,
            moving=int(degradations.moving_objects),
        )
    return build_room(
        rng,
        path,
        place=plan.place,
        contrast=1.0 - degradations.low_texture,
        moving=int(degradations.moving_objects),
    )


class Imager:
    """The cameras of a rig in a world.

    Args:
        plan: motion and place.
        cameras: calibration.
        settings: shutter and sensor noise.
        degradations: what spoils the images.
        seed: of noise and flicker.
        world_seed: of the place.
        duration_s: the world leaves room for the motion this long.
        world_plan: a place of one's own, instead of the one that suits the motion.
    """

    def __init__(
        self,
        *,
        plan: PlannedMotion,
        cameras: Sequence[Camera],
        settings: CameraSettings,
        degradations: Degradations,
        seed: int,
        world_seed: int,
        duration_s: float,
        world_plan: WorldPlan | None = None,
    ) -> None:
        self._motion = plan.motion
        self._cameras = tuple(cameras)
        self._settings = settings
        self._degradations = degradations
        self._seed = seed
        self._noise_tile: np.ndarray | None = None
        if world_plan is None:
            world_plan = build_world(plan, world_seed, duration_s, degradations)
        self.world = World(world_plan)
        atlas = Atlas(world_plan.textures)
        self._renderers = [Renderer(self.world, atlas, camera) for camera in self._cameras]

    def images(self, t_s: float) -> tuple[np.ndarray, ...]:
        """(H, W) uint8 of every camera whose first row sees the world at ``t_s``, s on the motion."""
        return tuple(self._expose(self._grey(index, t_s), index, t_s) for index in range(len(self._cameras)))

    def view(self, t_s: float, camera: int = 0) -> View:
        """Brightness, depth and surface of an instant, without blur or noise."""
        self.world.move_to(t_s)
        return self._renderers[camera].render(self._pose(camera, t_s))

    def depth(self, t_s: float, camera: int = 0) -> np.ndarray:
        """Depth along the optical axis (H, W) m, exact at pixel centres; 0 where the camera is blind."""
        self.world.move_to(t_s)
        return self._renderers[camera].render(self._pose(camera, t_s), smooth_edges=False).depth

    def flow(self, t_s: float, later_s: float, camera: int = 0) -> tuple[Array, Mask]:
        """Where the pixels of one instant are at another: displacement (H, W, 2) px, and seen (H, W).

        Exact for every camera model, for objects that move and for a shutter that rolls; ``later_s`` may also be
        the earlier of the two. ``seen`` is False where the point leaves the image, is hidden at the other instant,
        or the camera is blind.
        """
        moved = self.world.offsets(later_s) - self.world.offsets(t_s)
        return exact_flow(self._cameras[camera], self._sight(t_s, camera), self._sight(later_s, camera), moved)

    def _sight(self, t_s: float, camera: int) -> Sight:
        self.world.move_to(t_s)
        pose = self._pose(camera, t_s)
        view = self._renderers[camera].render(pose, smooth_edges=False)
        return Sight(depth=view.depth, face=view.face, T_world_cam=pose)

    def _pose(self, camera: int, t_s: float) -> Array:
        """T_world_cam (4, 4), or (H, 4, 4) under a rolling shutter."""
        model = self._cameras[camera]
        readout_s = self._settings.rolling_shutter_s
        if readout_s == 0.0:
            pose: Array = self._motion.evaluate(t_s).T_world_body @ model.T_body_cam
            return pose
        height = model.size_px[1]
        rows: Array = self._motion.evaluate(t_s + np.arange(height) * (readout_s / (height - 1))).T_world_body
        return rows @ model.T_body_cam

    def _grey(self, camera: int, t_s: float) -> np.ndarray:
        exposure_s = self._degradations.motion_blur_s
        if exposure_s == 0.0:
            return self.view(t_s, camera).grey
        # The stamp is the middle of the exposure.
        count = self._blur_steps(camera, t_s)
        offsets = ((np.arange(count) + 0.5) / count - 0.5) * exposure_s
        total = self.view(t_s + offsets[0], camera).grey
        for offset in offsets[1:]:
            total = total + self.view(t_s + offset, camera).grey
        mean: np.ndarray = total / np.float32(count)
        return mean

    def _blur_steps(self, camera: int, t_s: float) -> int:
        """Instants that an exposure around ``t_s`` is averaged over, by how far the picture moves meanwhile."""
        model, half_s = self._cameras[camera], 0.5 * self._degradations.motion_blur_s
        ends = self._motion.evaluate(np.array([t_s - half_s, t_s + half_s])).T_world_body @ model.T_body_cam
        between = se3.inverse(ends[0]) @ ends[1]
        shift = float(np.linalg.norm(between[:3, 3])) / _BLUR_DISTANCE_M
        moved_px = float(model.intrinsics_px[0]) * (float(so3.angle(between[:3, :3])) + shift)
        least = _BLUR_OF_OBJECTS if self._degradations.moving_objects else 1
        return min(max(math.ceil(moved_px / _BLUR_STEP_PX), least), _BLUR_MOST)

    def _expose(self, grey: np.ndarray, camera: int, t_s: float) -> np.ndarray:
        """What the sensor makes of the light: gain, noise, eight bits."""
        d = self._degradations
        # Of the instant, not of the order of calls: a frame is the same whenever it is drawn.
        rng = np.random.default_rng([self._seed, 30, camera, round(t_s * 1e6) + 10**9])
        gain = 1.0
        if d.exposure_ramp > 0.0:
            gain *= (1.0 + d.exposure_ramp) ** np.sin(2.0 * np.pi * t_s / d.exposure_period_s)
        if d.flicker > 0.0:
            gain *= float(np.exp(d.flicker * rng.standard_normal()))
        noise = self._noise(rng, grey.shape)
        if d.low_light > 0.0:
            # The camera's own gain makes up for half (in stops) of the light that is missing, and raises the
            # noise of the photo-electrons left and of the read-out with it.
            left = 1.0 - d.low_light
            amplified = left**-0.5
            light = grey * np.float32(gain * left)
            variance = np.maximum(light, 0.0) * np.float32(255.0 / _FULL_WELL)
            variance += np.float32(self._settings.noise_dn**2 + _READ_NOISE_DN**2)
            light += np.sqrt(variance) * noise
            light *= np.float32(amplified)
        else:
            light = grey * np.float32(gain)
            light += np.float32(self._settings.noise_dn) * noise
        light += np.float32(0.5)
        np.clip(light, 0.0, 255.0, out=light)
        image: np.ndarray = light.astype(np.uint8)
        return image

    def _noise(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Unit white noise (H, W) float32: windows of one large sheet, since drawing it anew takes too long."""
        height, width = shape
        if self._noise_tile is None or any(have < 2 * n for have, n in zip(self._noise_tile.shape, shape, strict=True)):
            sheet = np.random.default_rng([self._seed, 31])
            self._noise_tile = sheet.standard_normal((2 * height, 2 * width), dtype=np.float32)
        y, x = int(rng.integers(height)), int(rng.integers(width))
        return self._noise_tile[y : y + height, x : x + width]
