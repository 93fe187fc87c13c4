"""Starts in motion at random times of replays, and the faults that the doctor must name there.

    python benchmarks/initialisation.py --root DATA/euroc_imu_gt [--starts 20] [--sequences V1_01_easy ...]
    python benchmarks/initialisation.py --root DATA/euroc_imu_gt --faults --sequences V1_02_medium

Every sequence goes through the front end once; then ``--starts`` starters begin at random images of it, each
knowing nothing of what came before. One has succeeded if it starts within 5 s of sufficient motion, with the size
of the path over its window within 10 % of the truth. Motion is sufficient when the truth, over the last second,
turned by 3°, moved by 0.15 m, and changed its velocity by 0.2 m/s. ``--scratch`` keeps what was drawn and tracked.
"""

import argparse
import pickle
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from playing import DrawnRecording, draw, use_one_thread

from vioframe.conventions import NANOSECONDS, seconds
from vioframe.geometry import so3
from vioframe.geometry.interpolation import differentiate_positions, interpolate_poses
from vioframe.tight import doctor
from vioframe.tight.motion_options import MotionStartOptions
from vioframe.tight.motion_start import MotionStart
from vioframe.tight.options import CalibrationOptions
from vioframe.tight.solved_path import SolvedPath
from vioframe.types import ImuBias, ImuBlock, Measurement, SensorRig, SyncedWindow, Tracks, Trajectory, VisualFeatures
from vioframe_klt import KltFrontend
from vioframe_preintegration import Preintegration
from vioframe_sync import InterpolateSynchronizer

SEQUENCES = ("V1_01_easy", "V1_02_medium", "V2_01_easy", "MH_01_easy", "MH_04_difficult")
IN_TIME_S = 5.0
MOST_SCALE_ERROR = 0.1
TURN_DEG, MOVED_M, CHANGED_MS = 3.0, 0.15, 0.2


@dataclass(frozen=True)
class Tracked:
    """A sequence after the front end: measurements without pixels, calibration, truth."""

    measurements: list[Measurement]
    rig: SensorRig
    truth: Trajectory


def track(root: Path, sequence: str, cameras: int, scratch: Path) -> Tracked:
    """Draw a replay and follow its points, unless that was done before."""
    kept = scratch / f"tracked_{sequence}_{cameras}.pkl"
    if kept.exists():
        return Tracked(**pickle.loads(kept.read_bytes()))
    rig_name = "mono" if cameras == 1 else "stereo"
    source = [f"dataset.source.root={root}", f"dataset.source.sequence={sequence}"]
    path = draw(scratch, "dataset=replay", *source, "dataset.seed=0", f"rig={rig_name}")
    recording = DrawnRecording(path, cameras)
    synchronizer, frontend, integrator = InterpolateSynchronizer(), KltFrontend(), Preintegration()
    for part in (synchronizer, frontend, integrator):
        part.setup(recording.rig)
    measurements: list[Measurement] = []
    for packet in recording.packets():
        for window in synchronizer.push(packet):
            if not measurements:
                frontend.process(window.previous)
            turn = integrator.integrate(window.imu, ImuBias()).delta_R
            features = frontend.process(window.current, turn)
            bare = replace(
                window, previous=replace(window.previous, images=()), current=replace(window.current, images=())
            )
            slim = VisualFeatures(frame=bare.current, tracks=features.tracks, stereo=features.stereo)
            measurements.append(Measurement(window=bare, features=slim))
    tracked = {"measurements": measurements, "rig": recording.rig, "truth": recording.ground_truth()}
    kept.write_bytes(pickle.dumps(tracked))
    return Tracked(**tracked)


def sufficient(tracked: Tracked, first: int) -> int | None:
    """Index of the first measurement by which the truth has moved enough since ``first``; None if it never does."""
    stamps = np.array([each.window.current.stamp_ns for each in tracked.measurements[first:]])
    T, known = interpolate_poses(tracked.truth, stamps, max_gap_ns=NANOSECONDS // 10)
    velocity = differentiate_positions(tracked.truth)
    since = tracked.truth.stamps_ns - tracked.truth.stamps_ns[0]
    v = np.stack([np.interp(stamps - tracked.truth.stamps_ns[0], since, axis) for axis in velocity.T], axis=1)
    for end in range(1, len(stamps)):
        start = int(np.searchsorted(stamps, stamps[end] - NANOSECONDS))
        if stamps[end] - stamps[0] < NANOSECONDS or not known[start : end + 1].all():
            continue
        turn = np.degrees(so3.angle(T[start, :3, :3].T @ T[start : end + 1, :3, :3]).max())
        moved = np.linalg.norm(T[start : end + 1, :3, 3] - T[start, :3, 3], axis=1).max()
        changed = np.linalg.norm(v[start : end + 1] - v[start], axis=1).max()
        if turn >= TURN_DEG and moved >= MOVED_M and changed >= CHANGED_MS:
            return first + end
    return None


def try_start(tracked: Tracked, first: int, ready: int) -> tuple[str, bool]:
    """A start at measurement ``first``: a line that tells what became of it, and whether that is a success."""
    starter = MotionStart(tracked.rig, MotionStartOptions(), CalibrationOptions())
    ready_ns = tracked.measurements[ready].window.current.stamp_ns
    faults: Counter[str] = Counter()
    for measurement in tracked.measurements[first:]:
        stamp_ns = measurement.window.current.stamp_ns
        if seconds(stamp_ns - ready_ns) > IN_TIME_S:
            break
        start, attempt = starter.push(measurement)
        if attempt is not None and attempt.fault:
            faults[attempt.fault] += 1
        if start is not None:
            path = starter.solved
            size = np.nan if path is None else path.size_against(true_path(tracked.truth)) or np.nan
            line = f"after {seconds(stamp_ns - ready_ns):5.2f} s of motion, scale {size:.3f}  {dict(faults)}"
            return line, bool(abs(size - 1.0) <= MOST_SCALE_ERROR)
    return f"not started  {dict(faults)}", False


def true_path(truth: Trajectory) -> SolvedPath:
    """The truth as a path that a start's can be held against."""
    return SolvedPath(stamps_ns=truth.stamps_ns, p=truth.T_world_body[:, :3, 3], v=differentiate_positions(truth))


def random_starts(tracked: Tracked, name: str, count: int, seed: int) -> list[bool]:
    """``count`` random starts of a sequence; those after which too little is left are drawn again."""
    rng = np.random.default_rng(seed)
    results: list[bool] = []
    while len(results) < count:
        first = int(rng.integers(len(tracked.measurements)))
        ready = sufficient(tracked, first)
        last_ns = tracked.measurements[-1].window.current.stamp_ns
        if ready is None or last_ns - tracked.measurements[ready].window.current.stamp_ns < IN_TIME_S * NANOSECONDS:
            continue
        line, good = try_start(tracked, first, ready)
        results.append(good)
        print(f"{name} image {first:5d}  {'good' if good else 'BAD '}  {line}", flush=True)
    return results


def with_imu(change: Callable[[ImuBlock], ImuBlock]) -> Callable[[Measurement], Measurement]:
    """A fault of the inertial samples."""
    return lambda m: replace(m, window=replace(m.window, imu=change(m.window.imu)))


def with_tracks(change: Callable[[Tracks], Tracks]) -> Callable[[Measurement], Measurement]:
    """A fault of the points."""

    def changed(measurement: Measurement) -> Measurement:
        features = measurement.features
        if features is None or features.tracks is None:
            return measurement
        return replace(measurement, features=replace(features, tracks=change(features.tracks)))

    return changed


def some(tracks: Tracks, keep: np.ndarray) -> Tracks:
    """These points only."""
    return replace(
        tracks,
        ids=tracks.ids[keep],
        pixels=tracks.pixels[keep],
        bearings=tracks.bearings[keep],
        scores=tracks.scores[keep],
        descriptors=None,
    )


def half(imu: ImuBlock, rng: np.random.Generator) -> ImuBlock:
    """Every other sample lost at random; those at the images are the synchronizer's."""
    keep = rng.random(len(imu)) < 0.5
    keep[[0, -1]] = True
    return ImuBlock(stamps_ns=imu.stamps_ns[keep], gyro=imu.gyro[keep], accel=imu.accel[keep])


def delayed(measurements: Sequence[Measurement], images: int) -> list[Measurement]:
    """Each image's points arrive with the stamp of the image that is ``images`` later."""
    late = []
    for before, after in zip(measurements[:-images], measurements[images:], strict=True):
        features = before.features
        frame = after.window.current
        late.append(replace(after, features=None if features is None else replace(features, frame=frame)))
    return late


def faulty(tracked: Tracked, first: int, count: int) -> dict[str, tuple[SensorRig, list[Measurement]]]:
    """The measurements with each of ten faults; a body that does not turn or not accelerate is in the tests."""
    rng = np.random.default_rng(0)
    rig, good = tracked.rig, tracked.measurements[first : first + count]
    axes = [1, 0, 2]
    T_body_cam = rig.cameras[0].T_body_cam.copy()
    T_body_cam[:3, :3] = T_body_cam[:3, :3] @ so3.exp(np.array([0.0, 0.0, np.pi / 2]))
    wrong_rig = replace(rig, cameras=(replace(rig.cameras[0], T_body_cam=T_body_cam), *rig.cameras[1:]))
    largest = 0.5 * float(np.percentile(np.abs(np.concatenate([m.window.imu.gyro for m in good])), 99))
    spacing = seconds(good[1].window.current.stamp_ns - good[0].window.current.stamp_ns)
    changes = {
        doctor.NO_TEXTURE: with_tracks(lambda t: some(t, np.zeros(0, dtype=int))),
        doctor.TOO_FEW_POINTS: with_tracks(lambda t: some(t, np.arange(min(10, len(t))))),
        doctor.POINTS_BEHIND: with_tracks(lambda t: replace(t, bearings=-t.bearings)),
        doctor.SWAPPED_AXES: with_imu(lambda i: replace(i, gyro=i.gyro[:, axes], accel=i.accel[:, axes])),
        doctor.GRAVITY_SIGN: with_imu(lambda i: replace(i, accel=-i.accel)),
        doctor.SATURATED: with_imu(lambda i: replace(i, gyro=np.clip(i.gyro, -largest, largest))),
        doctor.IMU_HOLES: with_imu(lambda i: half(i, rng)),
    }
    cases = {name: (rig, [change(m) for m in good]) for name, change in changes.items()}
    cases[doctor.WRONG_EXTRINSICS] = (wrong_rig, list(good))
    cases[doctor.TIME_OFFSET] = (rig, delayed(good, round(0.2 / spacing)))
    cases[doctor.STANDSTILL] = (rig, [replace(m, features=good[0].features, window=still(m, good[0])) for m in good])
    return cases


def still(measurement: Measurement, first: Measurement) -> SyncedWindow:
    """A window in which the inertial sensor repeats the means of the first one, with a little noise."""
    imu, rest = measurement.window.imu, first.window.imu
    noise = 0.005 * np.random.default_rng(measurement.window.current.stamp_ns % 2**32).normal(size=imu.gyro.shape)
    up = rest.accel.mean(axis=0)
    accel = 9.81 * up / np.linalg.norm(up) + noise
    return replace(measurement.window, imu=replace(imu, gyro=np.zeros_like(imu.gyro) + noise, accel=accel))


def name_faults(tracked: Tracked, name: str, seconds_long: float = 5.0) -> None:
    """What the doctor says of each fault, from where the sequence moves."""
    middle = len(tracked.measurements) // 3
    ready = sufficient(tracked, middle) or middle
    for fault, (rig, measurements) in faulty(tracked, ready, round(20 * seconds_long)).items():
        starter = MotionStart(rig, MotionStartOptions(), CalibrationOptions())
        said: Counter[str] = Counter()
        for measurement in measurements:
            start, attempt = starter.push(measurement)
            if attempt is not None:
                said[attempt.fault or "started"] += 1
            if start is not None:
                break
        named = said.most_common(1)[0][0] == fault
        print(f"{name} {'named' if named else 'MISSED'}  {fault:20s} {dict(said)}", flush=True)


def main() -> None:
    """Print one line a start or a fault, and the share of successes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, required=True, help="folder of the EuRoC excerpts")
    parser.add_argument("--sequences", nargs="+", default=list(SEQUENCES))
    parser.add_argument("--starts", type=int, default=20, help="of each sequence")
    parser.add_argument("--cameras", type=int, choices=(1, 2), default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--faults", action="store_true", help="inject faults instead")
    parser.add_argument("--scratch", type=Path, help="keep what was drawn there for the next time, 1 GB a minute")
    arguments = parser.parse_args()
    use_one_thread()
    with tempfile.TemporaryDirectory() as temporary:
        scratch = arguments.scratch or Path(temporary)
        scratch.mkdir(parents=True, exist_ok=True)
        results: list[bool] = []
        for name in arguments.sequences:
            tracked = track(arguments.root.resolve(), name, arguments.cameras, scratch)
            if arguments.faults:
                name_faults(tracked, name)
            else:
                results += random_starts(tracked, name, arguments.starts, arguments.seed)
        if results:
            print(f"{sum(results)} of {len(results)} starts good ({np.mean(results):.0%})")


if __name__ == "__main__":
    main()
