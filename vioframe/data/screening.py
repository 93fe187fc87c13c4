"""Checks of what was recorded: units, rates, clocks. What would spoil every result raises; the rest is reported."""

import numpy as np

from vioframe.checks import Mask, Stamps
from vioframe.conventions import seconds
from vioframe.data.recording import Finding
from vioframe.errors import ClockError, DataError
from vioframe.types import ImuBlock, Trajectory

# 2000 °/s is the widest range of the inertial sensors in use; 2000 °/s = 34.9 rad/s.
FASTEST_RATE = 35.0
# Zero-rate offsets of consumer gyros stay below 20 °/s = 0.35 rad/s (data sheet of the MPU-6050); a larger mean
# while the accelerometer reads one constant vector is a unit, or a very steady turn, hence the margin.
LARGEST_QUIET_RATE = 1.0
# The mean of |specific force| is g within a few percent in the recordings known to us (9.79 to 10.04 m/s²);
# the margin leaves room for aggressive flight, not for another unit (1 g) or for gravity taken out (near 0).
ACCEL_RANGE = (7.0, 14.0)


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
