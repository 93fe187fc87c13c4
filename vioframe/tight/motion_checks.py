"""What can be said against a start in motion before anything is solved, cause by cause."""

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.geometry import so3
from vioframe.initialisation import StillnessDetector, measure_stillness
from vioframe.tight import doctor
from vioframe.tight.doctor import Examination
from vioframe.tight.gyro_bias import RotationFit
from vioframe.tight.inertial_window import InertialWindow
from vioframe.tight.motion_options import MotionStartOptions
from vioframe.tight.motion_window import Sight
from vioframe.tight.rotation_agreement import Agreement
from vioframe.types import ImuBlock, ImuNoise, SensorRig

# An image with fewer points than this shows nothing that a front end can follow.
_BLANK = 5
# Between these shares of its rate a sensor lost samples; a hole of several samples is one that hides motion.
_LEAST_RATE = 0.8
_LONGEST_HOLE = 5.0
# A rate that is clipped stays at exactly its largest value.
_CLIPPED_SAMPLES = 3
_CLIPPED_SHARE = 0.01
# Agreement of gyro and camera: this share of their motion, or a residual that noise explains.
_AGREES_SHARE = 0.3
_AGREES_RATE = 0.05
# An explanation must leave less than this share of the residual that it explains.
_EXPLAINS = 0.5
_CLEARLY_LESS = 0.8
# Below this residual, rad/s, there is nothing to explain.
_NOISE_RATE = 0.02
# A delay up to this is found and followed; a camera that is turned by less is refined.
_MOST_DELAY_S = 0.08
_LEAST_ANGLE_DEG = 10.0
_STILL_DEG = 0.2


def check_inertial(examination: Examination, inertial: InertialWindow, noise: ImuNoise) -> None:
    """Missing samples, and clipped ones."""
    steps = np.diff(inertial.elapsed)
    span = float(inertial.elapsed[-1] - inertial.elapsed[0])
    # The synchronizer adds a sample at every image, which makes short steps and hides no hole.
    rate = 1.0 / float(np.median(_measured_steps(steps, noise.rate_hz)))
    received = len(_measured_steps(steps, noise.rate_hz)) / max(span * noise.rate_hz, 1.0)
    hole = 1e3 * float(steps.max())
    examination.note("IMU rate", rate, "Hz")
    examination.at_least(
        "IMU samples",
        received,
        _LEAST_RATE,
        "",
        doctor.IMU_HOLES,
        f"only {received:.0%} of the inertial samples arrive (stated rate {noise.rate_hz:g} Hz, longest hole "
        f"{hole:.0f} ms): check the connection, or the stated rate",
    )
    limit = max(1e3 * _LONGEST_HOLE / noise.rate_hz, 30.0)
    examination.at_most(
        "longest IMU hole",
        hole,
        limit,
        "ms",
        doctor.IMU_HOLES,
        f"inertial samples are missing for {hole:.0f} ms (limit {limit:.0f} ms): check the connection",
    )
    for name, values, fault in (
        ("gyro", inertial.gyro, doctor.SATURATED),
        ("accelerometer", inertial.accel, doctor.SATURATED_ACCEL),
    ):
        clipped = _clipped_share(values)
        examination.at_most(
            f"clipped {name}",
            clipped,
            _CLIPPED_SHARE,
            "",
            fault,
            f"the {name} stays at its largest value ({np.abs(values).max():.3g}) in {clipped:.0%} of its samples: "
            "choose a larger range, or move more gently",
        )


def _measured_steps(steps: Array, rate_hz: float) -> Array:
    """Steps (N,) between measured samples: pieces that an interpolated sample cut are joined again."""
    total = np.cumsum(steps)
    marks = np.floor(total * rate_hz + 0.5)
    kept = total[np.flatnonzero(np.diff(marks, prepend=0.0) > 0.0)]
    measured: Array = np.diff(kept, prepend=0.0)
    return measured


def _clipped_share(values: Array) -> float:
    """Share of the samples (N, 3) that stay at their axis' extreme for several samples in a row."""
    worst = 0.0
    for axis in values.T:
        for extreme in (axis.max(), axis.min()):
            at = np.isclose(axis, extreme, rtol=1e-6, atol=1e-9)
            runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[False], at, [False]]))))[::2]
            worst = max(worst, float(runs[runs >= _CLIPPED_SAMPLES].sum()) / len(axis))
    # A sensor that stands still may repeat a number too; what is clipped is far from the rest.
    return worst if np.ptp(values) > 1e-3 else 0.0


def check_points(examination: Examination, sight: Sight, options: MotionStartOptions) -> None:
    """Whether there are points, whether they last, and whether they lie before the camera."""
    each = float(np.median(sight.seen.sum(axis=1)))
    examination.at_least(
        "points an image",
        each,
        _BLANK,
        "",
        doctor.NO_TEXTURE,
        f"the images show {each:.0f} points: point the camera at something with texture, or give it light",
    )
    lasting = float((sight.seen.sum(axis=0) >= min(4, len(sight.times))).sum())
    together = min(each, lasting)
    examination.at_least(
        "lasting points",
        together,
        options.min_points,
        "",
        doctor.TOO_FEW_POINTS,
        f"only {together:.0f} points are followed through the images ({options.min_points} are needed): move more "
        "slowly, or raise frontend.max_points",
    )
    ahead = float((sight.bearings[sight.seen][:, 2] > 0.0).mean()) if sight.seen.any() else 1.0
    examination.at_least(
        "rays ahead",
        ahead,
        0.5,
        "",
        doctor.POINTS_BEHIND,
        f"only {ahead:.0%} of the rays point ahead of the camera (z forward): check the camera's axes",
    )


def check_standstill(examination: Examination, inertial: InertialWindow, sight: Sight, rig: SensorRig) -> None:
    """Whether body and images rest."""
    flow = image_flow_deg(sight)
    examination.note("image flow", flow, "°")
    detector = StillnessDetector(rig)
    still = detector.motion(measure_stillness(inertial.part(0.0, np.inf)))
    if still is None and flow < _STILL_DEG:
        examination.blame(
            doctor.STANDSTILL,
            f"the body stands still (the points move by {flow:.2g}°): move it, or use fuser.start.method=auto",
        )


def image_flow_deg(sight: Sight) -> float:
    """Largest median angle, degrees, by which points move between the images of the window and its first ones."""
    flows = [0.0]
    for start in (0, len(sight.times) // 2):
        for end in range(start + 1, len(sight.times)):
            both = sight.seen[start] & sight.seen[end]
            if both.sum() >= _BLANK:
                apart = np.linalg.norm(sight.bearings[start, both] - sight.bearings[end, both], axis=1)
                flows.append(float(np.degrees(np.median(apart))))
    return max(flows)


def check_rotations(
    examination: Examination,
    agreement: Agreement,
    turn_deg: float,
    R_body_cam: Array,
    options: MotionStartOptions,
    *,
    find: bool,
) -> None:
    """Whether the body turns, and whether gyro and camera turn alike; what explains it best if they do not.

    Args:
        examination: takes the measures.
        agreement: of gyro and camera.
        turn_deg: by how much the camera turns over the window, degrees.
        R_body_cam: (3, 3) as calibrated.
        options: limits.
        find: the camera's rotation on the body is not known.
    """
    examination.note("turn rate", agreement.turning, "rad/s")
    turned = examination.at_least(
        "turn",
        turn_deg,
        options.min_turn_deg,
        "°",
        doctor.NO_ROTATION,
        f"the body turns by {turn_deg:.1f}° only ({options.min_turn_deg:g}° are needed): turn it about two axes",
    )
    apart = float(np.degrees(so3.angle(R_body_cam.T @ agreement.R_body_cam)))
    examination.note("rotation from gyro to camera differs", apart, "°")
    examination.note("delay by rotation", 1e3 * agreement.delay_s, "ms")
    if not turned:
        return
    limit = max(_AGREES_SHARE * agreement.turning, _AGREES_RATE)
    residual = agreement.residual_rotated if find else agreement.residual
    fault, sentence = _explanation(agreement, residual, apart, find=find)
    agrees = residual <= limit and not fault
    examination.hold("gyro against camera", residual, limit, "rad/s", good=agrees)
    if fault:
        examination.blame(fault, sentence)
    elif not agrees:
        examination.blame(
            doctor.DISAGREEMENT,
            f"gyro and camera turn differently by {residual:.2g} rad/s (limit {limit:.2g}), which neither a delay nor "
            "a rotation explains: check the calibration, or wait for better tracks",
        )


def _explanation(agreement: Agreement, residual: float, apart_deg: float, *, find: bool) -> tuple[str, str]:
    """Fault and sentence of what explains most of the residual; empty where nothing does, or nothing has to."""
    if residual < _NOISE_RATE:
        return "", ""
    delayed = agreement.residual_delayed_rotated if find else agreement.residual_delayed
    explanations = []
    if abs(agreement.delay_s) > _MOST_DELAY_S:
        sentence = (
            f"gyro and camera agree if the camera's stamps are moved by {1e3 * agreement.delay_s:+.0f} ms: set the "
            "recording's camera_delay_s, or let the driver stamp the middle of the exposure"
        )
        explanations.append((delayed, doctor.TIME_OFFSET, sentence))
    # Where the body turns about two axes only, a rotation explains whatever a mirror does.
    mirrored = agreement.residual_mirrored
    if mirrored < _CLEARLY_LESS * agreement.residual_rotated:
        sentence = (
            "gyro and camera agree only if an axis is mirrored: two axes of the inertial sensor are swapped, or one "
            "has the wrong sign"
        )
        explanations.append((mirrored, doctor.SWAPPED_AXES, sentence))
    if not find and apart_deg > _LEAST_ANGLE_DEG:
        sentence = (
            f"gyro and camera agree only if the camera is turned by {apart_deg:.0f}° on the body: check T_body_cam, "
            "or use fuser.calibration.extrinsics=find"
        )
        explanations.append((agreement.residual_rotated, doctor.WRONG_EXTRINSICS, sentence))
    left, fault, sentence = min(explanations, default=(np.inf, "", ""))
    return (fault, sentence) if left < _EXPLAINS * residual else ("", "")


def check_excitation(
    examination: Examination,
    inertial: InertialWindow,
    sight: Sight,
    fit: RotationFit,
    options: MotionStartOptions,
    *,
    metric: bool,
) -> None:
    """Whether the body accelerates, and whether the points move apart from the rotation.

    Args:
        examination: takes the measures.
        inertial: samples of the window.
        sight: its images.
        fit: gyro bias, and the camera's rotation on the body.
        options: limits.
        metric: two cameras know the scale, so that no acceleration is needed.
    """
    times = inertial.elapsed
    force = (inertial.rotations(times, fit.gyro_bias) @ inertial.accel[..., None])[..., 0]
    # Gravity is constant in a frame that does not turn; motors that shake are averaged away.
    still = measure_stillness(
        ImuBlock(stamps_ns=np.round(times * NANOSECONDS).astype(np.int64), gyro=force, accel=force)
    )
    accel = float(np.linalg.norm(still.accel_scatter))
    examination.hold("acceleration", accel, options.min_accel, "m/s²", good=accel >= options.min_accel or metric)
    if accel < options.min_accel and not metric:
        examination.blame(
            doctor.NO_ACCELERATION,
            f"the acceleration varies by {accel:.2g} m/s² only ({options.min_accel:g} are needed): one camera knows no "
            "scale at constant speed; accelerate, or use rig=stereo",
        )
    parallax = parallax_deg(inertial, sight, fit)
    examination.at_least(
        "parallax",
        parallax,
        options.min_parallax_deg,
        "°",
        doctor.NO_PARALLAX,
        f"the points move by {parallax:.2g}° apart from the rotation ({options.min_parallax_deg:g}° are needed): move "
        "sideways, or nearer to what is seen",
    )


def parallax_deg(inertial: InertialWindow, sight: Sight, fit: RotationFit) -> float:
    """Median angle, degrees, between the first and the last ray to a point, in a frame that does not turn."""
    R = inertial.rotations(sight.times, fit.gyro_bias) @ fit.R_body_cam
    rays = sight.bearings @ R.swapaxes(-1, -2)
    points = np.flatnonzero(sight.seen.sum(axis=0) >= 3)
    if not len(points):
        return 0.0
    first = np.argmax(sight.seen[:, points], axis=0)
    last = len(sight.times) - 1 - np.argmax(sight.seen[::-1, points], axis=0)
    apart = np.linalg.norm(rays[first, points] - rays[last, points], axis=1)
    return float(np.degrees(np.median(apart)))
