"""What must hold of a bag before it is run: order of stamps, units, clocks that overlap."""

import numpy as np

from vioframe.checks import Stamps
from vioframe.conventions import seconds
from vioframe.data.recording import Finding
from vioframe.errors import ClockError, DataError
from vioframe.types import ImuBlock

# 2000 °/s, the widest range of the inertial sensors in use.
FASTEST_RATE = 35.0
# Median magnitude of specific force, m/s²: leaves room for aggressive motion, not for units of g or for
# gravity taken out.
ACCEL_RANGE = (7.0, 14.0)


def check_order(stamps_ns: Stamps, where: str) -> None:
    """Refuse header stamps that repeat or go back.

    Args:
        stamps_ns: (N,) in the order of recording.
        where: bag and topic.

    Raises:
        ClockError: with the first offending message and both stamps.
    """
    steps = np.diff(stamps_ns)
    if not len(steps) or steps.min() > 0:
        return
    index = int(np.argmax(steps <= 0))
    before, after = int(stamps_ns[index]), int(stamps_ns[index + 1])
    how = "repeats the one before" if before == after else "is earlier than the one before"
    advice = "the driver does not fill in header.stamp" if not after else "drop or sort such messages"
    raise ClockError(
        f"{where}: the header stamp {after} ns of message {index + 2} {how} ({before} ns): {advice}; record or filter "
        "the bag anew"
    )


def check_imu(imu: ImuBlock, rate_hz: float, where: str) -> list[Finding]:
    """Units of both sensors, rate and holes.

    Raises:
        DataError: units that cannot be rad/s and m/s².
    """
    fastest = float(np.abs(imu.gyro).max())
    if fastest > FASTEST_RATE:
        raise DataError(
            f"{where}: the gyro reaches {fastest:.1f} rad/s, beyond the {FASTEST_RATE:g} rad/s (2000 °/s) that such "
            "sensors measure, so these are degrees per second: convert them to rad/s"
        )
    magnitude = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if not ACCEL_RANGE[0] <= magnitude <= ACCEL_RANGE[1]:
        raise DataError(
            f"{where}: the accelerometer reads {magnitude:.3g} m/s² in the median, but specific force is about "
            "9.81 m/s²: multiples of g must be multiplied by 9.81, and gravity must not be taken out"
        )
    units = f"gyro up to {fastest:.2f} rad/s, accelerometer {magnitude:.2f} m/s² in the median"
    findings = [Finding(level="good", subject="imu units", text=units)]
    step_ns = float(np.median(np.diff(imu.stamps_ns)))
    measured = 1e9 / step_ns
    text = f"{measured:.1f} Hz, {len(imu)} samples"
    if abs(measured / rate_hz - 1.0) > 0.1:
        text += f", but the calibration says {rate_hz:g} Hz; the stamps are believed"
        findings.append(Finding(level="note", subject="imu rate", text=text))
    else:
        findings.append(Finding(level="good", subject="imu rate", text=text))
    steps = np.diff(imu.stamps_ns)
    holes = int((steps > 3.0 * step_ns).sum())
    if holes:
        text = f"{holes} hole{'s' * (holes > 1)}, the longest {seconds(int(steps.max())):.3f} s; kept as they are"
        findings.append(Finding(level="note", subject="imu gaps", text=text))
    return findings


def check_frames(stamps_ns: Stamps, imu: ImuBlock, delay_ns: int, where: str) -> tuple[np.ndarray, list[Finding]]:
    """Which frames the inertial samples cover, and the rate of the frames.

    Args:
        stamps_ns: (F,) camera clock.
        imu: all samples.
        delay_ns: ``t_imu = t_cam + delay``.
        where: bag and topic.

    Returns:
        covered (F,), and what to tell.

    Raises:
        ClockError: the two clocks do not overlap.
    """
    on_imu = stamps_ns + delay_ns
    first, last = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
    covered = (on_imu >= first) & (on_imu <= last)
    if covered.sum() < 2:
        raise ClockError(
            f"{where}: the camera runs from {int(on_imu[0])} to {int(on_imu[-1])} ns and the IMU from {first} to "
            f"{last} ns, which do not overlap: check that both drivers stamp with one clock, or set "
            "dataset.camera_delay_s"
        )
    findings = []
    left_out = int((~covered).sum())
    if left_out:
        text = f"{left_out} of {len(covered)} frames lie before the first or after the last IMU sample and are left out"
        findings.append(Finding(level="note", subject="camera and imu clocks", text=text))
    steps = np.diff(stamps_ns)
    usual = float(np.median(steps))
    holes = int((steps > 1.5 * usual).sum())
    text = f"{1e9 / usual:.2f} Hz, {len(stamps_ns)} frames"
    if holes:
        text += f"; {holes} hole{'s' * (holes > 1)}, the longest {seconds(int(steps.max())):.3f} s"
    findings.append(Finding(level="note" if holes else "good", subject="frame rate", text=text))
    return covered, findings
