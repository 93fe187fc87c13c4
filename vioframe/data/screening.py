"""Checks of what was recorded: units, axes, clocks. What would spoil every result raises; the rest is reported."""

from itertools import permutations, product

import numpy as np

from vioframe.checks import Array, Mask, Stamps
from vioframe.conventions import GRAVITY, seconds
from vioframe.data.recording import Finding
from vioframe.errors import ClockError, DataError
from vioframe.geometry import so3
from vioframe.geometry.interpolation import differentiate_positions, interpolate_poses
from vioframe.types import ImuBlock, Trajectory

# 2000 °/s is the widest range of the inertial sensors in use; 2000 °/s = 34.9 rad/s.
FASTEST_RATE = 35.0
# Zero-rate offsets of consumer gyros stay below 20 °/s = 0.35 rad/s (data sheet of the MPU-6050); a larger mean
# while the accelerometer reads one constant vector is a unit, or a very steady turn, hence the margin.
LARGEST_QUIET_RATE = 1.0
# The mean of |specific force| is g within a few percent in the recordings known to us (9.79 to 10.04 m/s²);
# the margin leaves room for aggressive flight, not for another unit (1 g) or for gravity taken out (near 0).
ACCEL_RANGE = (7.0, 14.0)
# Another order or sign of the axes must fit twice as well as the one in the file to call the file wrong; in the
# recordings known to us the file's own fits best, by a factor of 1.01 to 26. Fewer intervals prove nothing.
AXES_EVIDENCE, FEWEST_INTERVALS = 2.0, 20

# Mean specific force in the world against the vertical: up to 2.8° in the recordings known to us.
TILT_NOTE_DEG, TILT_BAD_DEG = 1.5, 20.0


def check_samples(imu: ImuBlock, where: str, rate_hz: float) -> list[Finding]:
    """Units of both sensors, and the rate.

    Args:
        imu: all samples.
        where: file or topic, for messages.
        rate_hz: nominal rate.

    Raises:
        DataError: a unit that cannot be rad/s or m/s².
    """
    findings = [_check_rate(imu.stamps_ns, rate_hz), *_check_saturation(imu)]
    fastest = float(np.abs(imu.gyro).max())
    if fastest > FASTEST_RATE:
        raise DataError(
            f"{where}: the gyro reaches {fastest:.1f} rad/s, beyond the {FASTEST_RATE:g} rad/s (2000 °/s) that such "
            "sensors measure, so these are degrees per second: convert them to rad/s"
        )
    quiet = find_quiet(imu)
    if quiet is not None:
        offset = float(np.linalg.norm(imu.gyro[quiet[0] : quiet[1]].mean(axis=0)))
        if offset > LARGEST_QUIET_RATE:
            raise DataError(
                f"{where}: the gyro reads {offset:.2f} rad/s on average at stamp {int(imu.stamps_ns[quiet[0]])} while "
                "the accelerometer reads one constant vector, as at rest, so these look like degrees per second: "
                "convert them to rad/s"
            )
    findings.append(Finding(level="good", subject="gyro unit", text=f"rad/s: the fastest rate is {fastest:.2f} rad/s"))
    magnitude = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if not ACCEL_RANGE[0] <= magnitude <= ACCEL_RANGE[1]:
        guess = (
            "these look like multiples of g: multiply by 9.81"
            if 0.8 < magnitude < 1.3
            else "gravity seems to be taken out: raw specific force is needed"
            if magnitude < ACCEL_RANGE[0]
            else "check unit and scale"
        )
        raise DataError(
            f"{where}: the accelerometer reads {magnitude:.3g} m/s² in the median, but specific force is about "
            f"9.81 m/s² for a body that comes back to where it was; {guess}"
        )
    findings.append(
        Finding(level="good", subject="accelerometer unit", text=f"m/s²: the median magnitude is {magnitude:.2f} m/s²")
    )
    if quiet is not None:
        at_rest = float(np.linalg.norm(imu.accel[quiet[0] : quiet[1]].mean(axis=0)))
        text = f"the first quiet second (rest or steady motion) reads {at_rest:.2f} m/s² on average"
        plausible = abs(at_rest - 9.81) < 0.6
        findings.append(Finding(level="good" if plausible else "note", subject="gravity", text=text))
    return findings


def _check_rate(stamps_ns: Stamps, rate_hz: float) -> Finding:
    measured = 1e9 / float(np.median(np.diff(stamps_ns)))
    if abs(measured / rate_hz - 1.0) > 0.1:
        text = f"{measured:.1f} Hz, but the calibration says {rate_hz:g} Hz; the stamps are believed"
        return Finding(level="note", subject="imu rate", text=text)
    return Finding(level="good", subject="imu rate", text=f"{measured:.1f} Hz, {len(stamps_ns)} samples")


def _check_saturation(imu: ImuBlock) -> list[Finding]:
    """An extreme value that comes back again and again is the end of the sensor's range."""
    findings = []
    for name, values, unit in (("gyro", imu.gyro, "rad/s"), ("accelerometer", imu.accel, "m/s²")):
        extreme = float(np.abs(values).max())
        count = int((np.abs(values) > extreme * (1 - 1e-9)).sum())
        if extreme > 0 and count > max(5, len(imu) // 2000):
            text = f"the {name} reaches ±{extreme:.2f} {unit} in {count} samples: it may be saturated there"
            findings.append(Finding(level="note", subject=f"{name} range", text=text))
    return findings


def find_quiet(imu: ImuBlock, window_s: float = 1.0) -> tuple[int, int] | None:
    """Index range of the first second in which the accelerometer is quiet, or None."""
    step_s = float(np.median(np.diff(imu.stamps_ns))) / 1e9
    count = max(round(window_s / step_s), 2)
    if step_s > 0.05:
        return None
    for start in range(0, len(imu) - count + 1, count):
        # 0.1 m/s² is above the noise of the sensors in use and below what any carried or flying body does.
        if imu.accel[start : start + count].std(axis=0).max() < 0.1:
            return start, start + count
    return None


def find_gaps(stamps_ns: Stamps, max_gap_ns: int) -> Stamps:
    """Indices of the samples before holes: steps longer than ``max_gap_ns`` and than twice the usual one."""
    if len(stamps_ns) < 2:
        return np.zeros(0, dtype=np.int64)
    steps = np.diff(stamps_ns)
    found: Stamps = np.flatnonzero(steps > max(max_gap_ns, 2 * float(np.median(steps)))).astype(np.int64)
    return found


def describe_gaps(stamps_ns: Stamps, before: Stamps) -> str:
    """Number and longest of the holes after the samples ``before``, of which there is at least one."""
    lengths = stamps_ns[before + 1] - stamps_ns[before]
    longest = int(np.argmax(lengths))
    return (
        f"{len(before)} hole{'s' * (len(before) > 1)}, the longest {seconds(int(lengths[longest])):.3f} s after stamp "
        f"{int(stamps_ns[before[longest]])}"
    )


def check_gaps(stamps_ns: Stamps, max_gap_ns: int) -> Finding:
    """Holes between the inertial samples, where they are left to the synchronizer."""
    before = find_gaps(stamps_ns, max_gap_ns)
    if not len(before):
        return Finding(level="good", subject="imu gaps", text="none")
    return Finding(level="note", subject="imu gaps", text=f"{describe_gaps(stamps_ns, before)}; kept as they are")


def check_frame_clock(frame_stamps_ns: Stamps, imu: ImuBlock, delay_ns: int, where: str) -> tuple[Mask, Finding]:
    """Which frames the inertial samples cover.

    Args:
        frame_stamps_ns: (F,) camera clock.
        imu: all samples.
        delay_ns: ``t_imu = t_cam + delay``.
        where: file or topic of the camera's stamps, for messages.

    Returns:
        covered (F,), and what to tell.

    Raises:
        ClockError: the two clocks do not overlap.
    """
    on_imu = frame_stamps_ns + delay_ns
    first, last = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
    covered = (on_imu >= first) & (on_imu <= last)
    if covered.sum() < 2:
        raise ClockError(
            f"{where}: the camera runs from {int(on_imu[0])} to {int(on_imu[-1])} ns and the IMU from {first} to "
            f"{last} ns, which do not overlap: check that both are in ns by one clock, or set dataset.camera_delay_s"
        )
    left_out = int((~covered).sum())
    if left_out:
        text = f"{left_out} of {len(covered)} frames lie before the first or after the last IMU sample and are left out"
        return covered, Finding(level="note", subject="camera and imu clocks", text=text)
    return covered, Finding(level="good", subject="camera and imu clocks", text="the IMU covers every frame")


def check_frame_steps(frame_stamps_ns: Stamps) -> Finding:
    """Rate of the frames, and holes between them."""
    steps = np.diff(frame_stamps_ns)
    usual = float(np.median(steps))
    holes = int((steps > 1.5 * usual).sum())
    text = f"{1e9 / usual:.2f} Hz, {len(frame_stamps_ns)} frames"
    if holes:
        longest = seconds(int(steps.max()))
        text += f"; {holes} hole{'s' * (holes > 1)}, the longest {longest:.3f} s"
        return Finding(level="note", subject="frame rate", text=text)
    return Finding(level="good", subject="frame rate", text=text)


def check_truth_of_frames(frame_stamps_ns: Stamps, truth: Trajectory) -> Finding:
    """How many frames (IMU clock) lie within the ground truth: errors are told over those only."""
    inside = (frame_stamps_ns >= truth.stamps_ns[0]) & (frame_stamps_ns <= truth.stamps_ns[-1])
    text = f"covers {int(inside.sum())} of {len(inside)} frames"
    if not inside.any():
        text += ": errors of this selection cannot be told, and init=groundtruth cannot start"
    level_good = inside.mean() > 0.5
    return Finding(level="good" if level_good else "note", subject="ground truth of the frames", text=text)


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


def correlations(measured: Array, true: Array) -> Array:
    """Correlation (3,) of each axis of (M, 3) with the same axis."""
    a, b = measured - measured.mean(axis=0), true - true.mean(axis=0)
    spread = np.sqrt((a * a).sum(axis=0) * (b * b).sum(axis=0))
    values: Array = (a * b).sum(axis=0) / np.maximum(spread, 1e-12)
    return values


def _check_rotation(imu: ImuBlock, truth: Trajectory, where: str, advice: str) -> list[Finding]:
    measured, true = rotation_rates(imu, truth)
    if len(true) < 10 or true.std() < 0.01:
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
