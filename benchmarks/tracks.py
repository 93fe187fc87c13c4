"""Tracks of a front end against the exact motion of a drawn scene: drift, life, spread, stereo, time.

    OMP_NUM_THREADS=1 python benchmarks/tracks.py --replay /data/euroc_imu_gt [--frontend orb] [--stereo]
        [--sequence V1_01_easy,V1_02_medium] [--start 20] [--seconds 8] [--set refinement=gradient ...]
    ... --frontend superpoint [--encoder vgg] [--set weights=FILE]

The recorded motion is drawn anew; the point that a track began with is known from the depth of that image, and every
later observation is compared with where that point is seen. Tracks that begin at an edge of depth are left out.
"""

import argparse
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import yaml

from vioframe.checks import Array
from vioframe.data.simulator import ReplayDataset
from vioframe.geometry import camera as projection
from vioframe.geometry import se3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.interfaces import Frontend
from vioframe.types import Frame
from vioframe_klt import KltFrontend
from vioframe_opencv import SiftFrontend
from vioframe_orb import OrbFrontend
from vioframe_recordings import EurocDataset
from vioframe_superpoint import SuperPointFrontend
from vioframe_superpoint.options import WIDTHS, encoder_named

FRONTENDS = {"klt": KltFrontend, "orb": OrbFrontend, "sift": SiftFrontend, "superpoint": SuperPointFrontend}
AGES = ((2, 6), (6, 16), (16, 41), (41, 10**6))
EDGE_RATIO = 1.03
GROSS_PX = 3.0
GRID = (8, 5)


@dataclass
class Tally:
    """Everything measured on one sequence."""

    milliseconds: list[float] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    cells: list[int] = field(default_factory=list)
    drift: dict[int, list[float]] = field(default_factory=dict)
    lives: dict[int, int] = field(default_factory=dict)
    stereo: list[Array] = field(default_factory=list)
    stereo_share: list[float] = field(default_factory=list)


def depth_at(depth: Array, pixels: Array) -> tuple[Array, np.ndarray]:
    """Depth (M,) between four pixels, whose inverse is linear on a plane, and whether it jumps there (M,)."""
    height, width = depth.shape
    column = np.clip(np.floor(pixels[:, 0]).astype(int), 0, width - 2)
    row = np.clip(np.floor(pixels[:, 1]).astype(int), 0, height - 2)
    x, y = pixels[:, 0] - column, pixels[:, 1] - row
    corners = np.stack([depth[row + j, column + i] for j in (0, 1) for i in (0, 1)], axis=-1)
    weights = np.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return 1.0 / np.sum(weights / corners, axis=-1), ~(corners.max(-1) < EDGE_RATIO * corners.min(-1))


def measure(recording, frontend: Frontend, start_s: float, seconds: float, *, stereo: bool) -> Tally:
    """Run the front end over a stretch of the recording, with the true rotation in the place of the gyro's."""
    rig, trajectory, imager = recording.rig, recording.ground_truth(), recording.imager
    left = rig.cameras[0]
    frontend.setup(rig)
    tally, known, before = Tally(), {}, None
    first_ns = int(recording.frame_stamps_ns[0])
    for stamp_ns in recording.frame_stamps_ns:
        if not 0.0 <= (stamp_ns - first_ns) * 1e-9 - start_s <= seconds:
            continue
        elapsed = float(recording.elapsed_s(stamp_ns))
        poses, covered = interpolate_poses(trajectory, np.array([stamp_ns]), max_gap_ns=10**9)
        if not covered[0]:
            continue
        T_world_cam = poses[0] @ left.T_body_cam
        frame = Frame(stamp_ns=int(stamp_ns), images=imager.images(elapsed))
        turn = None if before is None else before[:3, :3].T @ poses[0][:3, :3]
        before = poses[0]
        started = time.process_time()
        features = frontend.process(frame, turn)
        tally.milliseconds.append(1e3 * (time.process_time() - started))
        tracks = features.tracks
        cell = np.minimum((tracks.pixels / np.array(left.size_px) * GRID).astype(int), np.array(GRID) - 1)
        tally.count.append(len(tracks))
        tally.cells.append(len(np.unique(cell @ np.array([1, GRID[0]]))))
        distance, edge = depth_at(imager.depth(elapsed).astype(float), tracks.pixels)
        points = tracks.bearings / tracks.bearings[:, 2:] * distance[:, None]
        in_world = se3.transform(T_world_cam, points)
        for row, identity in enumerate(tracks.ids.tolist()):
            known.setdefault(identity, None if edge[row] else in_world[row])
            tally.lives[identity] = tally.lives.get(identity, 0) + 1
        rows = [row for row, identity in enumerate(tracks.ids.tolist()) if known[identity] is not None]
        origin = np.array([known[int(tracks.ids[row])] for row in rows]).reshape(-1, 3)
        expected, _ = projection.project(left, se3.transform(se3.inverse(T_world_cam), origin))
        for row, error in zip(rows, np.linalg.norm(tracks.pixels[rows] - expected, axis=-1), strict=True):
            age = tally.lives[int(tracks.ids[row])]
            if age > 1:
                tally.drift.setdefault(age, []).append(float(error))
        if stereo and features.stereo is not None and len(tracks):
            rows_left = np.searchsorted(tracks.ids, features.stereo.ids)
            T_right_left = se3.inverse(rig.cameras[1].T_body_cam) @ left.T_body_cam
            expected, _ = projection.project(rig.cameras[1], se3.transform(T_right_left, points[rows_left]))
            error = np.linalg.norm(features.stereo.pixels - expected, axis=-1)
            tally.stereo.append(error[~edge[rows_left]])
            tally.stereo_share.append(len(rows_left) / len(tracks))
    return tally


def describe(name: str, tally: Tally) -> str:
    """One line of figures."""
    ages = []
    for low, high in AGES:
        errors = [error for age, each in tally.drift.items() if low <= age < high for error in each]
        ages.append(f"{np.median(errors):.2f} ({np.percentile(errors, 90):.2f})" if errors else "-")
    errors = np.concatenate([np.array(each) for each in tally.drift.values()])
    line = (
        f"{name}: {np.mean(tally.count):.0f} tracks in {np.mean(tally.cells):.1f} of {GRID[0] * GRID[1]} cells, "
        f"{np.mean(list(tally.lives.values())):.1f} images long; drift px, median (90 %), followed for 2-5, 6-15, "
        f"16-40, more: {', '.join(ages)}; beyond {GROSS_PX:.0f} px {100 * np.mean(errors > GROSS_PX):.1f} %"
    )
    if tally.stereo:
        stereo = np.concatenate(tally.stereo)
        line += (
            f"; stereo {100 * np.mean(tally.stereo_share):.0f} % found, {np.median(stereo):.2f} "
            f"({np.percentile(stereo, 90):.2f}) px, beyond 2 px {100 * np.mean(stereo > 2.0):.1f} %"
        )
    return f"{line}; {np.mean(tally.milliseconds):.1f} ms CPU, 95 % {np.percentile(tally.milliseconds, 95):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replay", type=Path, required=True, help="folder of EuRoC truth and inertial samples")
    parser.add_argument("--sequence", default="V1_01_easy,V1_02_medium,V2_01_easy,MH_04_difficult")
    parser.add_argument("--frontend", choices=FRONTENDS, default="klt")
    parser.add_argument("--stereo", action="store_true")
    parser.add_argument("--start", type=float, default=20.0, help="s after the first image")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--encoder", choices=WIDTHS, default="mobilenetv2", help="of superpoint")
    parser.add_argument("--set", nargs="*", default=[], metavar="OPTION=VALUE", help="of the front end")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    chosen = {name: yaml.safe_load(value) for name, _, value in (each.partition("=") for each in options.set)}
    if options.frontend == "superpoint":
        chosen["encoder"] = encoder_named(options.encoder)
    cameras = 1 + options.stereo
    for sequence in options.sequence.split(","):
        source = EurocDataset(root=str(options.replay), sequence=sequence, cameras=cameras, images=False)
        data = ReplayDataset(source=source, cameras=cameras)
        frontend = FRONTENDS[options.frontend](stereo=options.stereo, **chosen)
        recording = data.open(data.sequences[0])
        tally = measure(recording, frontend, options.start, options.seconds, stereo=options.stereo)
        print(describe(sequence, tally), flush=True)


if __name__ == "__main__":
    main()
