"""The KLT front end and the geometric odometries on rendered images: accuracy, covariance, time.

    OMP_NUM_THREADS=1 python benchmarks/frontend.py [--vo local_map] [--family walk] [--seed 0] [--seconds 20]
    python benchmarks/frontend.py --vo stereo --family car --seconds 160
    python benchmarks/frontend.py --replay /data/euroc --sequence V1_02_medium --seconds 30

Frames go straight to the front end and the estimator; the rotation handed to the front end is the true one with a
constant gyro bias of 7 mrad/s. Position errors are of the chained motions, after Sim(3) alignment (SE(3) for stereo).
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator import CameraSettings, ReplayDataset, SimulatedDataset
from vioframe.geometry import se3, so3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.types import Frame, RelativePose
from vioframe_geometric import LocalMapVO, StereoVO, TwoViewVO
from vioframe_klt import KltFrontend
from vioframe_recordings import EurocDataset

GYRO_BIAS = np.array([0.004, -0.003, 0.005])
ESTIMATORS = {"local_map": LocalMapVO, "stereo": StereoVO, "twoview": TwoViewVO}
SEGMENTS_M = range(100, 801, 100)


def align(told: Array, true: Array, *, scaled: bool) -> tuple[float, Array]:
    """Scale and aligned positions (N, 3) (Umeyama 1991)."""
    x, y = told - told.mean(axis=0), true - true.mean(axis=0)
    u, d, vt = np.linalg.svd(y.T @ x)
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = float((d * sign).sum() / (x**2).sum()) if scaled else 1.0
    return scale, scale * x @ (u * sign @ vt).T + true.mean(axis=0)


def drift(chain: Array, truth: Array) -> tuple[float, float, int]:
    """t_rel in percent and r_rel in degrees a 100 m, over segments of 100 to 800 m from every tenth pose."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=-1))])
    translation, rotation = [], []
    for length in SEGMENTS_M:
        for start in range(0, len(truth), 10):
            end = int(np.searchsorted(along, along[start] + length))
            if end >= len(truth):
                break
            error = se3.inverse(se3.inverse(truth[start]) @ truth[end]) @ se3.inverse(chain[start]) @ chain[end]
            translation.append(100.0 * np.linalg.norm(error[:3, 3]) / length)
            rotation.append(100.0 * np.degrees(so3.angle(error[:3, :3])) / length)
    return float(np.mean(translation)), float(np.mean(rotation)), len(translation)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vo", choices=ESTIMATORS, default="local_map")
    parser.add_argument("--family", default="walk")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--replay", type=Path, help="folder of EuRoC sequences to draw anew")
    parser.add_argument("--sequence", default="V1_02_medium")
    parser.add_argument("--start", type=float, default=0.0, help="s left out at the start of a replay")
    parser.add_argument("--no-gyro", action="store_true")
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)

    cameras = 2 if options.vo == "stereo" else 1
    if options.replay:
        source = EurocDataset(root=str(options.replay), sequence=options.sequence, images=False)
        data = ReplayDataset(source=source, cameras=cameras, start_s=options.start, duration_s=options.seconds)
    else:
        camera = CameraSettings(count=cameras)
        data = SimulatedDataset(sequence=options.family, seed=options.seed, duration_s=options.seconds, camera=camera)
    recording = data.open(data.sequences[0])
    trajectory = recording.ground_truth()
    estimator, frontend = ESTIMATORS[options.vo](), KltFrontend()
    estimator.setup(recording.rig)
    frontend.setup(recording.rig)

    T_body_cam = recording.rig.cameras[0].T_body_cam
    chain, truth, steps = [np.eye(4)], [], []
    seconds = {"frontend": [], "vo": []}
    before, frames, counts = None, 0, []
    for frame in recording.packets():
        if not isinstance(frame, Frame):
            continue
        stamp = np.array([frame.stamp_ns + recording.rig.camera_delay_ns])
        poses, covered = interpolate_poses(trajectory, stamp, max_gap_ns=10**9)
        if not covered[0]:
            continue
        frames += 1
        T_world_cam = poses[0] @ T_body_cam
        turn = None
        if before is not None and not options.no_gyro:
            elapsed_s = (frame.stamp_ns - before[0].frame.stamp_ns) * 1e-9
            turn = before[2][:3, :3].T @ poses[0][:3, :3] @ so3.exp(GYRO_BIAS * elapsed_s)
        started = time.process_time()
        features = frontend.process(frame, turn)
        seconds["frontend"].append(time.process_time() - started)
        counts.append(len(features.tracks))
        if before is not None:
            started = time.process_time()
            motion: RelativePose = estimator.estimate(before[0], features)
            seconds["vo"].append(time.process_time() - started)
            if motion.valid:
                truth = truth or [before[1]]
                chain.append(chain[-1] @ motion.T_prev_cur)
                truth.append(T_world_cam)
                steps.append((motion, se3.inverse(before[1]) @ T_world_cam))
        before = features, T_world_cam, poses[0]
    print(f"{data.sequences[0]}: {frames} frames, {np.mean(counts):.0f} tracks, valid {len(steps) / (frames - 1):.3f}")
    for part, times in seconds.items():
        low, middle, high = 1e3 * np.percentile(times, [50, 95, 100])
        print(f"  {part}: mean {1e3 * np.mean(times):.1f} ms CPU, median {low:.1f}, 95 % {middle:.1f}, most {high:.1f}")
    if len(steps) < 3 or options.vo == "twoview":
        return
    told, true = np.array(chain), se3.inverse(truth[0]) @ np.array(truth)
    scale, aligned = align(told[:, :3, 3], true[:, :3, 3], scaled=options.vo != "stereo")
    path = float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=-1).sum())
    rmse = float(np.sqrt(np.mean(np.sum((aligned - true[:, :3, 3]) ** 2, axis=-1))))
    turned = np.degrees(so3.angle(told[-1, :3, :3].T @ true[-1, :3, :3]))
    print(f"  path {path:.1f} m, RMSE {rmse:.4f} m = {100 * rmse / path:.2f} %, scale {scale:.4f}, turn {turned:.2f}°")
    nees = []
    for motion, step in steps:
        step[:3, 3] /= scale
        error = se3.log(se3.inverse(motion.T_prev_cur) @ step)
        nees.append(error @ np.linalg.solve(motion.covariance, error) / 6)
    print(f"  ANEES a degree of freedom of a step: mean {np.mean(nees):.2f}, median {np.median(nees):.2f}")
    if path > 150.0 and options.vo == "stereo":
        translation, rotation, segments = drift(told, true)
        print(f"  t_rel {translation:.3f} %, r_rel {rotation:.3f} °/100 m over {segments} segments")
    if options.plot:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot

        figure, axes = pyplot.subplots(1, 2, figsize=(13, 6))
        for axis, (across, up, names) in zip(axes, ((0, 2, "xz"), (0, 1, "xy")), strict=True):
            axis.plot(true[:, across, 3], true[:, up, 3], "k", label="truth")
            axis.plot(aligned[:, across], aligned[:, up], "C3", lw=1, label=options.vo)
            axis.set(xlabel=f"{names[0]} of the first camera, m", ylabel=f"{names[1]}, m", aspect="equal")
            axis.legend()
        figure.savefig(options.plot, dpi=110)


if __name__ == "__main__":
    main()
