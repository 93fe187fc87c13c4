"""Random points seen along known motions: tracks with pixel noise, births and deaths, and the true camera poses."""

from dataclasses import dataclass, field

import numpy as np

from vioframe.geometry import camera as projection
from vioframe.geometry import se3, so3
from vioframe.types import Camera, Frame, ImuNoise, SensorRig, Tracks, VisualFeatures

NOISE = ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=200.0)
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
DISTORTION = {"pinhole": [], "radtan": [-0.283, 0.0739, 2e-4, 2e-5], "equidistant": [0.01, -0.01, 0.004, -0.001]}


def make_rig(model="radtan", cameras=2):
    """A rig like EuRoC's: 752×480, 11 cm apart, not rectified."""
    T = np.eye(4)
    T[:3, :3] = R_BODY_CAM
    T_other = T @ se3.exp(np.array([0.01, -0.008, 0.005, 0.11, 0.0, 0.001]))
    intrinsics = (np.array([458.6, 457.3, 367.2, 248.4]), np.array([457.6, 456.1, 379.9, 255.2]))
    made = [
        Camera(
            model=model, intrinsics_px=k, distortion=np.array(DISTORTION[model]), size_px=(752, 480), T_body_cam=pose
        )
        for k, pose in zip(intrinsics, (T, T_other), strict=True)
    ]
    return SensorRig(cameras=tuple(made[:cameras]), imu=NOISE)


def make_room(seed, count=2500, size=(8.0, 6.0, 3.5)):
    """Points on the walls of a room and on boxes in it, (count, 3)."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
    points *= size
    points[:, 2] += size[2] / 2
    some = count // 5
    centres = rng.uniform(-0.4, 0.4, (6, 3)) * size
    centres[:, 2] = 0.5
    points[:some] = centres[rng.integers(0, 6, some)] + rng.uniform(-0.5, 0.5, (some, 3))
    return points


def make_walk(count, seed=0, rate_hz=20.0):
    """A smooth walk through the room, about 1.3 m/s, T_world_body (count, 4, 4)."""
    rng = np.random.default_rng(seed)
    time = np.arange(count)[:, None] / rate_hz
    rates, phases = rng.uniform(0.05, 0.25, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
    position = sum(np.sin(2 * np.pi * rates[i] * time + phases[i]) for i in range(3)) * [1.1, 0.8, 0.2]
    position[:, 2] += 1.6
    yaw = 2 * np.pi * 0.06 * time[:, 0] + 0.6 * np.sin(2 * np.pi * rates[3, 0] * time[:, 0] + phases[3, 0])
    tilt = np.zeros((count, 3))
    tilt[:, :2] = [0.1, 0.15] * np.sin(4 * np.pi * rates[4, :2] * time + phases[4, :2])
    return se3.from_parts(so3.rotation_z(yaw) @ so3.exp(tilt), position)


@dataclass
class Scene:
    """Yields features and the true pose of camera 0, frame by frame; ``pairs[stamp]`` has the truth of camera 1."""

    rig: SensorRig
    T_world_body: np.ndarray
    points: np.ndarray
    sigma_px: float = 0.5
    outliers: float = 0.0
    lose: float = 0.02
    most: int = 150
    seed: int = 0
    blind: tuple = ()
    pairs: dict = field(default_factory=dict)

    def __iter__(self):
        rng = np.random.default_rng(self.seed)
        camera = self.rig.cameras[0]
        alive, ids, next_id = np.zeros(0, dtype=int), np.zeros(0, dtype=np.int64), 0
        for step, T_world_body in enumerate(self.T_world_body):
            T_world_cam = T_world_body @ camera.T_body_cam
            pixels, visible = see(camera, T_world_cam, self.points)
            if step in self.blind:
                visible = np.zeros_like(visible)
            keep = visible[alive] & (rng.random(len(alive)) > self.lose)
            alive, ids = alive[keep], ids[keep]
            if len(alive) < 0.85 * self.most:
                new = rng.permutation(np.setdiff1d(np.flatnonzero(visible), alive))[: self.most - len(alive)]
                alive = np.concatenate([alive, new])
                ids = np.concatenate([ids, np.arange(next_id, next_id + len(new))])
                next_id += len(new)
            measured = pixels[alive] + self.sigma_px * rng.standard_normal((len(alive), 2))
            wrong = rng.random(len(alive)) < self.outliers
            measured[wrong] += rng.uniform(-15, 15, (int(wrong.sum()), 2))
            stamp_ns = step * 50_000_000
            if len(self.rig.cameras) > 1:
                other = self.rig.cameras[1]
                T_world_other = T_world_body @ other.T_body_cam
                there, seen = see(other, T_world_other, self.points[alive])
                there = there + self.sigma_px * rng.standard_normal(there.shape)
                self.pairs[stamp_ns] = projection.bearings(other, there), seen & (rng.random(len(seen)) < 0.9)
            tracks = Tracks(
                ids=ids,
                pixels=measured,
                bearings=projection.bearings(camera, measured),
                scores=np.ones(len(ids)),
            )
            yield VisualFeatures(frame=Frame(stamp_ns=stamp_ns), tracks=tracks), T_world_cam


def see(camera, T_world_cam, points):
    """Pixels of points and whether they are in view, not at the far edge of the distortion."""
    local = (points - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    pixels, visible = projection.project(camera, local)
    near = (np.abs(local[:, 0]) < 1.2 * local[:, 2]) & (np.abs(local[:, 1]) < local[:, 2]) & (local[:, 2] > 0.3)
    return pixels, visible & near


@dataclass
class Run:
    """What an estimator said: the chained motions, the truth beside them, and every valid step with its number."""

    chain: np.ndarray
    truth: np.ndarray
    steps: list
    valid: np.ndarray

    @property
    def path(self):
        return float(np.linalg.norm(np.diff(self.truth[:, :3, 3], axis=0), axis=-1).sum())

    def aligned(self):
        """Scale (metres a unit) and position RMSE in m after Sim(3) alignment (Umeyama 1991)."""
        x, y = self.chain[:, :3, 3], self.truth[:, :3, 3]
        x0, y0 = x - x.mean(axis=0), y - y.mean(axis=0)
        u, d, vt = np.linalg.svd(y0.T @ x0)
        sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
        scale = float((d * sign).sum() / (x0**2).sum())
        return scale, float(np.sqrt(np.mean(np.sum((scale * x0 @ (u * sign @ vt).T - y0) ** 2, axis=-1))))

    def nees(self, scale=1.0):
        """Normalised squared error a degree of freedom of every valid step."""
        out = []
        for motion, truth, _ in self.steps:
            true = truth.copy()
            true[:3, 3] /= scale
            error = se3.log(se3.inverse(motion.T_prev_cur) @ true)
            out.append(error @ np.linalg.solve(motion.covariance, error) / 6)
        return np.array(out)


def run(vo, scene):
    """Feed a scene to an estimator; valid motions are chained."""
    vo.setup(scene.rig)
    chain, truth, steps, valid = [np.eye(4)], [], [], []
    before = None
    for step, (features, T_world_cam) in enumerate(scene):
        if before is not None:
            motion = vo.estimate(before[0], features)
            valid.append(motion.valid)
            if motion.valid:
                truth = truth or [before[1]]
                chain.append(chain[-1] @ motion.T_prev_cur)
                truth.append(T_world_cam)
                steps.append((motion, se3.inverse(before[1]) @ T_world_cam, step))
        before = features, T_world_cam
    return Run(
        np.array(chain), se3.inverse(truth[0]) @ np.array(truth) if truth else np.array(chain), steps, np.array(valid)
    )
