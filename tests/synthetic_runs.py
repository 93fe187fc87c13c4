"""Made-up runs with a known truth and known errors, for the tests of the evaluation."""

from dataclasses import replace

import numpy as np

from vioframe.evaluation.run import SampleFrame, SequenceRun
from vioframe.geometry import se3, so3
from vioframe.types import ImuBias, NavState, Trajectory

SECOND = 1_000_000_000


def walk(duration_s: float = 60.0, rate_hz: float = 20.0, start_ns: int = 1_403_715_273_262_142_976) -> Trajectory:
    """A walk through a hall: about 2 m/s, all three axes, heading along the path, a little roll and pitch."""
    count = round(duration_s * rate_hz) + 1
    t = np.arange(count) / rate_hz
    position = np.stack([12 * np.sin(0.16 * t), 8 * np.sin(0.32 * t + 0.3), 1.2 + 0.5 * np.sin(0.7 * t)], axis=1)
    step = np.gradient(position, t, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    roll, pitch = 0.12 * np.sin(1.3 * t), 0.09 * np.sin(0.9 * t + 1.0)
    zero = np.zeros(count)
    rotation = (
        so3.rotation_z(yaw)
        @ so3.exp(np.stack([zero, pitch, zero], axis=1))
        @ so3.exp(np.stack([roll, zero, zero], axis=1))
    )
    return Trajectory(
        stamps_ns=start_ns + np.round(t * SECOND).astype(np.int64),
        T_world_body=se3.from_parts(rotation, position),
        v_world_body=step,
    )


def moved(trajectory: Trajectory, T: np.ndarray, scale: float = 1.0) -> Trajectory:
    """The same trajectory in another world, and at another scale."""
    poses = T @ trajectory.T_world_body
    poses[:, :3, 3] = T[:3, 3] + scale * (poses[:, :3, 3] - T[:3, 3])
    return Trajectory(stamps_ns=trajectory.stamps_ns, T_world_body=poses, causal=trajectory.causal)


def drifted(truth: Trajectory, seed: int, position_walk: float = 0.02, angle_walk: float = 0.0008) -> list[NavState]:
    """States that drift from the truth as a random walk, with the covariance they were drawn from.

    Args:
        truth: where the body is.
        seed: of the noise.
        position_walk: m/√step. angle_walk: rad/√step.
    """
    random = np.random.default_rng(seed)
    states = []
    theta, position = np.zeros(3), np.zeros(3)
    bias = np.concatenate([random.normal(0, 0.002, 3), random.normal(0, 0.02, 3)])
    for k, stamp_ns in enumerate(truth.stamps_ns):
        if k:
            theta = theta + random.normal(0, angle_walk, 3)
            position = position + random.normal(0, position_walk, 3)
        sigma = np.concatenate(
            [
                np.full(3, angle_walk * np.sqrt(max(k, 1e-6))),
                np.full(3, position_walk * np.sqrt(max(k, 1e-6))),
                np.full(3, 0.05),
                np.full(3, 0.003 / np.sqrt(1 + 0.05 * k)),
                np.full(3, 0.03 / np.sqrt(1 + 0.02 * k)),
            ]
        )
        T_true = truth.T_world_body[k]
        # R_true = R Exp(θ), p_true = p + δp.
        T = se3.from_parts(T_true[:3, :3] @ so3.exp(-theta), T_true[:3, 3] - position)
        shown = bias * (1 - np.exp(-k / 80))
        states.append(
            NavState(
                stamp_ns=int(stamp_ns),
                T_world_body=T,
                v_world_body=np.zeros(3),
                bias=ImuBias(gyro=shown[:3], accel=shown[3:]),
                covariance=np.diag(sigma**2),
            )
        )
    return states


def make_run(
    name: str = "hall",
    seed: int = 0,
    duration_s: float = 60.0,
    turn: float = 0.0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    images: bool = False,
) -> SequenceRun:
    """A whole run: two seconds of starting, then drift, a short loss, and what a pipeline measures on the way.

    Args:
        name: of the sequence. seed: of the noise. duration_s: length of the recording.
        turn: rad about z, and ``shift`` in m: where the estimator put its world.
        images: with a few frames and tracks.
    """
    truth = walk(duration_s)
    T = se3.from_parts(so3.rotation_z(turn), np.array(shift))
    block = np.eye(15)
    block[3:6, 3:6] = T[:3, :3]
    block[6:9, 6:9] = T[:3, :3]
    states = []
    for k, state in enumerate(drifted(truth, seed)):
        status = "starting" if k < 40 else "lost" if 700 <= k < 730 else "tracking"
        covariance = None if state.covariance is None else block @ state.covariance @ block.T
        states.append(replace(state, T_world_body=T @ state.T_world_body, covariance=covariance, status=status))
    random = np.random.default_rng(seed)
    frames = len(truth)
    return SequenceRun(
        sequence=name,
        states=states[1:],
        smoothed=Trajectory(
            stamps_ns=truth.stamps_ns[40:],
            T_world_body=(T @ truth.T_world_body)[40:] @ se3.exp(random.normal(0, 0.002, (frames - 40, 6))),
            causal=False,
        ),
        ground_truth=truth,
        frames_expected=frames,
        duration_s=duration_s,
        pipeline_s=0.4 * duration_s,
        parts_s={
            "synchronizer": 0.01 * duration_s,
            "frontend": 0.22 * duration_s,
            "vo": 0.1 * duration_s,
            "integrator": 0.02 * duration_s,
            "fuser": 0.045 * duration_s,
        },
        windows=frames - 1,
        wall_s=0.7 * duration_s,
        counters={"dropped frames": 3, "IMU gaps": 1},
        track_stamps_ns=truth.stamps_ns[1:],
        track_counts=(150 + 30 * np.sin(np.arange(frames - 1) / 90) + random.normal(0, 8, frames - 1)).astype(np.int64),
        sample_frames=[_frame(random, int(truth.stamps_ns[k])) for k in range(100, frames, frames // 4)]
        if images
        else [],
        init="auto",
        uses_ground_truth=(),
    )


def _frame(random: np.random.Generator, stamp_ns: int) -> SampleFrame:
    coarse = random.integers(30, 220, (16, 24)).astype(np.uint8)
    image = np.kron(coarse, np.ones((30, 31), dtype=np.uint8))[:480, :752]
    pixels = random.uniform((20, 20), (730, 460), (120, 2))
    return SampleFrame(
        stamp_ns=stamp_ns, image=image, pixels=pixels, ids=np.sort(random.choice(2000, 120, replace=False))
    )
