"""Whether the inertial samples and the ground truth tell of one motion: axes, signs, units, the vertical."""

from itertools import permutations, product

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import GRAVITY, seconds
from vioframe.data.recording import Finding
from vioframe.data.screening import ACCEL_RANGE
from vioframe.errors import DataError
from vioframe.geometry import so3
from vioframe.geometry.interpolation import differentiate_positions, interpolate_poses
from vioframe.types import ImuBlock, Trajectory

# Another order or sign of the axes must fit twice as well as the one in the file to call the file wrong; in the
# recordings known to us the file's own fits best, by a factor of 1.01 to 26. Fewer intervals prove nothing.
AXES_EVIDENCE, FEWEST_INTERVALS = 2.0, 20

# Mean specific force in the world against the vertical: up to 2.8° in the recordings known to us.
TILT_NOTE_DEG, TILT_BAD_DEG = 1.5, 20.0


def check_with_truth(
    imu: ImuBlock,
    truth: Trajectory,
    where: str,
    *,
    vertical: bool = True,
    advice: str = "check the calibration and the ground-truth file",
) -> list[Finding]:
    """Compare the gyro with the true rotation, and the accelerometer with the true motion.

    Args:
        imu: all samples.
        truth: poses of the body.
        where: file or topic of the samples, for messages.
        vertical: also compare the accelerometer with the vertical.
        advice: what to look at where the two do not belong together.

    Raises:
        DataError: the gyro is in degrees, or the accelerometer does not measure +g upwards.
    """
    overlap = (imu.stamps_ns >= truth.stamps_ns[0]) & (imu.stamps_ns <= truth.stamps_ns[-1])
    if len(truth) < 10 or overlap.sum() < 10:
        text = "it hardly overlaps with the IMU, so that errors cannot be told: take another or none"
        return [Finding(level="bad", subject="ground truth", text=text)]
    share = 100.0 * float(overlap.mean())
    findings = [
        Finding(level="good", subject="ground truth", text=f"{len(truth)} poses over {share:.0f} % of the IMU samples")
    ]
    steps = np.diff(truth.stamps_ns)
    holes = int((steps > 5 * np.median(steps)).sum())
    if holes:
        longest = seconds(int(steps.max()))
        text = f"{holes} drop-outs, the longest {longest:.2f} s; they are kept as they are"
        findings.append(Finding(level="note", subject="ground truth gaps", text=text))
    findings += _check_rotation(imu, truth, where, advice)
    findings += _check_force(imu, truth, where, advice)
    if vertical:
        findings += _check_vertical(imu, truth, where, advice)
    return findings


def rotation_rates(imu: ImuBlock, truth: Trajectory, baseline_s: float = 0.1) -> tuple[Array, Array]:
    """Mean rates (M, 3) rad/s of the gyro and of the truth over the same intervals of about ``baseline_s``.

    Poses are noisy, so that rates between neighbours would mostly compare noise.
    """
    stamps_ns = truth.stamps_ns
    baseline_ns = int(baseline_s * 1e9)
    starts = np.searchsorted(stamps_ns, np.arange(stamps_ns[0], stamps_ns[-1], baseline_ns))
    pairs = np.stack([starts[:-1], starts[1:]], axis=1)
    first, last = stamps_ns[pairs[:, 0]], stamps_ns[pairs[:, 1]]
    usable = (last > first) & (last - first < 2 * baseline_ns)
    usable &= (first >= imu.stamps_ns[0]) & (last <= imu.stamps_ns[-1])
    pairs, first, last = pairs[usable], first[usable], last[usable]
    R = truth.T_world_body[:, :3, :3]
    elapsed = ((last - first) / 1e9)[:, None]
    true_rate = so3.log(np.swapaxes(R[pairs[:, 0]], -1, -2) @ R[pairs[:, 1]]) / elapsed
    times = (imu.stamps_ns - imu.stamps_ns[0]) / 1e9
    areas = 0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(times)[:, None]
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
    at = [
        np.stack([np.interp((stamps - imu.stamps_ns[0]) / 1e9, times, turned[:, axis]) for axis in range(3)], axis=1)
        for stamps in (first, last)
    ]
    return (at[1] - at[0]) / elapsed, true_rate


def turns_enough(true: Array) -> bool:
    """Whether rates (M, 3) rad/s of the truth are enough to compare those of a gyro with them."""
    return len(true) >= 10 and bool(true.std() >= 0.01)


def correlations(measured: Array, true: Array) -> Array:
    """Correlation (3,) of each axis of (M, 3) with the same axis."""
    a, b = measured - measured.mean(axis=0), true - true.mean(axis=0)
    spread = np.sqrt((a * a).sum(axis=0) * (b * b).sum(axis=0))
    values: Array = (a * b).sum(axis=0) / np.maximum(spread, 1e-12)
    return values


def _check_rotation(imu: ImuBlock, truth: Trajectory, where: str, advice: str) -> list[Finding]:
    measured, true = rotation_rates(imu, truth)
    if not turns_enough(true):
        return [Finding(level="note", subject="gyro and ground truth", text="too little rotation to compare")]
    centred = true - true.mean(axis=0)
    scale = float((measured * centred).sum() / (centred * centred).sum())
    if 30.0 < scale < 90.0:
        raise DataError(
            f"{where}: the gyro is {scale:.1f} times the rotation rate of the ground truth, as degrees are of radians "
            "(57.3): convert it to rad/s"
        )
    axes = better_axes(measured, true)
    if axes:
        raise DataError(
            f"{where}: the gyro agrees with the rotation of the ground truth only when its axes are taken as {axes}: "
            f"they are swapped, or the ground truth is that of another frame; {advice}"
        )
    # Axes about which the body hardly turns show the noise of the truth, not agreement.
    axis = int(np.argmax(true.std(axis=0)))
    values = correlations(measured, true)
    text = f"correlation {values[0]:.4f}, {values[1]:.4f}, {values[2]:.4f} (x, y, z), scale {scale:.3f}"
    if values[axis] < 0.8 or abs(scale - 1.0) > 0.2:
        text += f": axes, clock or unit of the two disagree; {advice}"
        return [Finding(level="bad", subject="gyro and ground truth", text=text)]
    return [Finding(level="good", subject="gyro and ground truth", text=text)]


def better_axes(measured: Array, expected: Array) -> str:
    """The order and signs of axes with which (M, 3) clearly fits better than as it is, or an empty text."""
    if len(measured) < FEWEST_INTERVALS:
        return ""
    misfits = {
        (order, signs): float(np.sqrt(((measured[:, list(order)] * signs - expected) ** 2).sum(axis=1).mean()))
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
    }
    order, signs = min(misfits, key=lambda choice: misfits[choice])
    if misfits[(0, 1, 2), (1, 1, 1)] < AXES_EVIDENCE * misfits[order, signs]:
        return ""
    names = [("" if sign > 0 else "−") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True)]
    return f"({', '.join(names)})"


def specific_forces(imu: ImuBlock, truth: Trajectory, interval_s: float = 0.5) -> tuple[Array, Array]:
    """Mean specific force (M, 3) m/s² in the body, measured and that of the true motion, over the same intervals.

    The true one is ``Rᵀ (dv/dt + g)``. Intervals that either of the two does not fill are left out.
    """
    velocity = differentiate_positions(truth)
    elapsed = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
    upward = np.gradient(velocity, elapsed, axis=0) + np.array([0.0, 0.0, GRAVITY])
    true = (np.swapaxes(truth.T_world_body[:, :3, :3], -1, -2) @ upward[..., None])[..., 0]
    start = max(int(truth.stamps_ns[0]), int(imu.stamps_ns[0]))
    end = min(int(truth.stamps_ns[-1]), int(imu.stamps_ns[-1]))
    interval_ns = int(interval_s * 1e9)
    count = (end - start) // interval_ns
    if count < 1:
        return np.zeros((0, 3)), np.zeros((0, 3))
    means, filled = [], np.ones(count, dtype=bool)
    for stamps_ns, values in ((imu.stamps_ns, imu.accel), (truth.stamps_ns, true)):
        which = (stamps_ns - start) // interval_ns
        inside = (which >= 0) & (which < count)
        samples = np.bincount(which[inside], minlength=count)
        sums = [np.bincount(which[inside], weights=values[inside, axis], minlength=count) for axis in range(3)]
        means.append(np.stack(sums, axis=1) / np.maximum(samples, 1)[:, None])
        filled &= samples > 0.8 * np.median(samples)
    return means[0][filled], means[1][filled]


def _check_force(imu: ImuBlock, truth: Trajectory, where: str, advice: str) -> list[Finding]:
    measured, true = specific_forces(imu, truth)
    if len(measured) < FEWEST_INTERVALS:
        return []
    axes = better_axes(measured, true)
    if axes:
        raise DataError(
            f"{where}: the accelerometer agrees with the motion of the ground truth only when its axes are taken as "
            f"{axes}: they are swapped or turned; {advice}"
        )
    misfit = float(np.sqrt(((measured - true) ** 2).sum(axis=1).mean()))
    text = f"within {misfit:.2f} m/s² of the true motion over intervals of 0.5 s (bias and errors of attitude)"
    return [Finding(level="good" if misfit < 1.0 else "note", subject="accelerometer and ground truth", text=text)]


def mean_specific_force(imu: ImuBlock, truth: Trajectory) -> tuple[Array, int]:
    """Mean specific force (3,) m/s² in the world over the samples that the truth covers, and their number.

    The mean acceleration of the body is taken out; over a long recording it vanishes, over a second it does not.
    """
    kept = np.arange(0, len(imu), max(len(imu) // 5000, 1))
    T, covered = interpolate_poses(truth, imu.stamps_ns[kept], max_gap_ns=200_000_000)
    if not covered.any():
        return np.zeros(3), 0
    force = (T[covered, :3, :3] @ imu.accel[kept][covered, :, None])[..., 0].mean(axis=0)
    inside = (truth.stamps_ns >= imu.stamps_ns[0]) & (truth.stamps_ns <= imu.stamps_ns[-1])
    known = truth.v_world_body if truth.v_world_body is not None else differentiate_positions(truth)
    velocity, stamps_ns = known[inside], truth.stamps_ns[inside]
    if len(velocity) > 1:
        force = force - (velocity[-1] - velocity[0]) / seconds(int(stamps_ns[-1] - stamps_ns[0]))
    return force, int(covered.sum())


def tilt_deg(force: Array) -> float:
    """Angle in degrees of a vector (3,) against the vertical."""
    return float(np.degrees(np.arctan2(np.hypot(force[0], force[1]), force[2])))


def _check_vertical(imu: ImuBlock, truth: Trajectory, where: str, advice: str) -> list[Finding]:
    force, count = mean_specific_force(imu, truth)
    if count < 10:
        return []
    tilt, size = tilt_deg(force), float(np.linalg.norm(force))
    if tilt > TILT_BAD_DEG or size < ACCEL_RANGE[0]:
        guess = "its sign is turned over" if tilt > 160.0 else "its axes are swapped or those of another frame"
        raise DataError(
            f"{where}: in the attitude of the ground truth the accelerometer reads {size:.2f} m/s² at {tilt:.0f}° from "
            f"the vertical on average, instead of about 9.81 m/s² upwards: {guess}; {advice}"
        )
    text = f"specific force in the world is {size:.2f} m/s² at {tilt:.2f}° from the vertical on average"
    if tilt > TILT_NOTE_DEG:
        text += ": the ground truth is not level or the accelerometer has a bias; errors of orientation contain it"
        return [Finding(level="note", subject="vertical", text=text)]
    return [Finding(level="good", subject="vertical", text=text)]
