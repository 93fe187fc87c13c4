"""What KITTI odometry and KITTI raw share: calibration by drive date and from files, MATLAB files, spline velocities.

Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 2013. The vehicle frame (x forward, y left, z up)
is that of the OXTS RT3003, and is our body.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import seconds
from vioframe.errors import DataError
from vioframe.geometry import se3, so3
from vioframe.types import Camera, ImuBlock


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveDate:
    """Calibration of one recording day.

    Attributes:
        date: of the raw drives.
        T_body_cam0: (4, 4) rectified camera 0 in the vehicle.
        size_px: (width, height) of the rectified images.
    """

    date: str
    T_body_cam0: Array
    size_px: tuple[int, int]


def _from_rotation_and_lever(R_cam_body: list[list[float]], p_body_cam: list[float]) -> Array:
    """T_body_cam0 of ``p_cam = C (p_imu − rho)``: C is R_cam_body, rho the camera's place in the vehicle."""
    # The printed factors have seven digits, so that their product is off a rotation by 2e-7.
    return se3.from_parts(so3.normalise(np.array(R_cam_body)).T, np.array(p_body_cam))


# calib_cam_to_cam, calib_velo_to_cam and calib_imu_to_velo of each date, multiplied out with R_rect_00.
DRIVE_DATES = (
    DriveDate(
        date="2011_10_03",
        T_body_cam0=_from_rotation_and_lever(
            [
                [0.0011966898955340518, -0.9999765779442381, 0.0067380368136895335],
                [-0.009241243397762784, -0.006748808357194415, -0.9999345308794726],
                [0.9999564932279168, 0.0011343429124442243, -0.00924910323549339],
            ],
            [1.1022431230795948, -0.31907194404377753, 0.7460658793390965],
        ),
        size_px=(1241, 376),
    ),
    DriveDate(
        date="2011_09_30",
        T_body_cam0=_from_rotation_and_lever(
            [
                [-0.0010886351426112838, -0.9999763472008827, 0.006787181800407023],
                [-0.008512072136469604, -0.006777671151801371, -0.999940871577287],
                [0.9999631769967771, -0.001146342925623756, -0.00850449310298544],
            ],
            [1.1438987057554275, -0.31271847125070873, 0.7265460454939783],
        ),
        size_px=(1226, 370),
    ),
    DriveDate(
        date="2011_09_26",
        T_body_cam0=_from_rotation_and_lever(
            [
                [0.000998747205656553, -0.9999903820710413, 0.004259378487637175],
                [0.00841690182755742, -0.004250821136069464, -0.9999555696753273],
                [0.9999640486966582, 0.001034553284226362, 0.008412575208732587],
            ],
            [1.0833019777196284, -0.3098889008003196, 0.7299197948915828],
        ),
        size_px=(1242, 375),
    ),
)

_ODOMETRY_DATES = {
    **{f"{index:02d}": "2011_10_03" for index in (0, 1, 2)},
    "03": "2011_09_26",
    **{f"{index:02d}": "2011_09_30" for index in range(4, 11)},
}


NOMINAL_RATE_HZ = 100.0
"""Of the OXTS RT3003, Hz."""


def sample_rate_hz(imu: ImuBlock) -> float:
    """Rate of the samples as they are in the file: interpolated or synchronised ones are not at the nominal rate."""
    return 1e9 / float(np.median(np.diff(imu.stamps_ns)))


def drive_date(date: str) -> DriveDate | None:
    """Calibration of a recording day, or None where it is not known."""
    return next((known for known in DRIVE_DATES if known.date == date), None)


def odometry_drive(sequence: str) -> DriveDate | None:
    """Recording day of a sequence of the odometry benchmark (00 to 10)."""
    return drive_date(_ODOMETRY_DATES.get(sequence, ""))


def read_key_numbers(path: Path, *, required: tuple[str, ...]) -> Mapping[str, Array]:
    """Rows ``key: numbers`` of a KITTI calibration file; rows that hold no numbers (dates) are passed over.

    Raises:
        DataError: missing file, missing key, or a required key without numbers; with file and line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise DataError(f"{path}: cannot be read; it should hold the calibration: check the recording") from None
    found: dict[str, Array] = {}
    for number, line in enumerate(text.split("\n"), start=1):
        key, colon, rest = line.partition(":")
        if not colon:
            continue
        try:
            values = np.array([float(token) for token in rest.split()])
        except ValueError:
            if key.strip() in required:
                raise DataError(
                    f"{path}:{number}: the key {key.strip()!r} should be followed by numbers, but is "
                    f"{rest.strip()[:60]!r}"
                ) from None
            continue
        if key.strip() in required and not np.isfinite(values).all():
            raise DataError(f"{path}:{number}: the key {key.strip()!r} has a number that is not finite: repair it")
        found[key.strip()] = values
    for key in required:
        if key not in found:
            raise DataError(f"{path}: the key {key!r} is missing; the file has {', '.join(found) or 'none'}: add it")
    return found


def read_mat(path: Path) -> Mapping[str, Array]:
    """Variables of a MATLAB 5 file.

    Raises:
        DataError: missing or damaged.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    # What scipy raises depends on where a file is damaged; NotImplementedError is its word for MATLAB 7.3 (HDF5).
    try:
        content: Mapping[str, Array] = loadmat(path)
    except (MatReadError, ValueError, NotImplementedError, OSError, TypeError, EOFError) as error:
        raise DataError(f"{path}: cannot be read as a MATLAB 5 file ({error}): fetch it again") from None
    return content


def projection_matrix(path: Path, values: Mapping[str, Array], key: str) -> Array:
    """P (3, 4) of a rectified camera.

    Raises:
        DataError: not twelve numbers, or no focal length.
    """
    numbers = values[key]
    if numbers.size != 12 or not (numbers[0] > 0 and numbers[5] > 0):
        raise DataError(f"{path}: the key {key!r} should be a 3×4 projection with positive fx, fy, got {numbers}")
    return numbers.reshape(3, 4)


def rectified_camera(P: Array, T_body_cam0: Array, size_px: tuple[int, int]) -> Camera:
    """A rectified camera: pinhole, beside camera 0 by ``K⁻¹ P[:, 3]`` (``p_cam = p_cam0 + K⁻¹ P[:, 3]``)."""
    T_cam0_cam = np.eye(4)
    T_cam0_cam[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
    return Camera(
        model="pinhole",
        intrinsics_px=np.array([P[0, 0], P[1, 1], P[0, 2], P[1, 2]]),
        size_px=size_px,
        T_body_cam=T_body_cam0 @ T_cam0_cam,
    )


def _body_to_cam0(day: Path) -> Array:
    """T_cam0_body (4, 4), of the unrectified camera 0, through the laser scanner."""
    chain = np.eye(4)
    for name in ("calib_imu_to_velo.txt", "calib_velo_to_cam.txt"):
        values = read_key_numbers(day / name, required=("R", "T"))
        chain = se3.from_parts(_matrix(day / name, values, "R"), _sized(day / name, values, "T", 3)) @ chain
    return chain


def _sized(path: Path, values: Mapping[str, Array], key: str, size: int) -> Array:
    if values[key].size != size:
        raise DataError(f"{path}: the key {key!r} should have {size} numbers, got {values[key].size}: repair it")
    return values[key]


def _matrix(path: Path, values: Mapping[str, Array], key: str) -> Array:
    return _sized(path, values, key, 9).reshape(3, 3)


def _size_px(path: Path, values: Mapping[str, Array], key: str) -> tuple[int, int]:
    width, height = _sized(path, values, key, 2)
    return int(width), int(height)


def rectified_cameras(day: Path, indices: tuple[int, int]) -> tuple[Camera, ...]:
    """Rectified cameras of a day, as in ``_sync`` drives: ``p_rect = R_rect_00 T_velo_cam T_imu_velo p_body``.

    Raises:
        DataError: with the file and the key.
    """
    path = day / "calib_cam_to_cam.txt"
    keys = tuple(f"{name}_{index:02d}" for index in indices for name in ("P_rect", "S_rect"))
    values = read_key_numbers(path, required=("R_rect_00", *keys))
    R_rect = _matrix(path, values, "R_rect_00")
    T_rect_body = se3.from_parts(R_rect, np.zeros(3)) @ _body_to_cam0(day)
    return tuple(
        rectified_camera(
            projection_matrix(path, values, f"P_rect_{index:02d}"),
            se3.inverse(T_rect_body),
            _size_px(path, values, f"S_rect_{index:02d}"),
        )
        for index in indices
    )


def raw_cameras(day: Path, indices: tuple[int, int]) -> tuple[Camera, ...]:
    """Unrectified cameras of a day, as in ``_extract`` drives: ``p_i = R_i p_0 + T_i``.

    Raises:
        DataError: with the file and the key.
    """
    path = day / "calib_cam_to_cam.txt"
    keys = tuple(f"{name}_{index:02d}" for index in indices for name in ("K", "D", "S", "R", "T"))
    values = read_key_numbers(path, required=keys)
    T_cam0_body = _body_to_cam0(day)
    cameras = []
    for index in indices:
        K = _matrix(path, values, f"K_{index:02d}")
        T_cam_cam0 = se3.from_parts(_matrix(path, values, f"R_{index:02d}"), _sized(path, values, f"T_{index:02d}", 3))
        cameras.append(
            Camera(
                model="radtan",
                intrinsics_px=np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
                distortion=_sized(path, values, f"D_{index:02d}", 5),
                size_px=_size_px(path, values, f"S_{index:02d}"),
                T_body_cam=se3.inverse(T_cam_cam0 @ T_cam0_body),
            )
        )
    return tuple(cameras)


# Of 1e-4 … 3e-1, this came closest to the velocity changes over 1 s that the accelerometers of sequences 01,
# 06 and 07 measured (0.04 to 0.07 m/s), where plain differences were off by up to 0.10 m/s.
_SPLINE_STIFFNESS = 3e-3
# Positions at an end that a cubic is fitted to, and how many more it adds.
_OUTERMOST = 10
_BEYOND = 8


def spline_velocities(stamps_ns: Stamps, positions: Array, stiffness: float = _SPLINE_STIFFNESS) -> Array:
    """Velocities (N, 3) m/s: derivative of a cubic smoothing spline through positions (N, 3).

    A smoothing spline is straight at its ends, which a vehicle in a curve is not (0.6 m/s off at the start of
    sequence 01). So it is made to end further out, on cubics through the outermost positions.

    Args:
        stamps_ns: (N,), N ≥ 5.
        positions: (N, 3) m.
        stiffness: weight of the squared second derivative, in s³ for samples every 0.1 s.
    """
    from scipy.interpolate import make_smoothing_spline

    elapsed = np.array([seconds(int(stamp - stamps_ns[0])) for stamp in stamps_ns])
    step = elapsed[-1] / (len(elapsed) - 1)
    beyond = step * np.arange(1, _BEYOND + 1)
    before, after = elapsed[0] - beyond[::-1], elapsed[-1] + beyond
    times = np.concatenate([before, elapsed, after])
    places = np.concatenate(
        [
            _on_cubic(elapsed[:_OUTERMOST], positions[:_OUTERMOST], before),
            positions,
            _on_cubic(elapsed[-_OUTERMOST:], positions[-_OUTERMOST:], after),
        ]
    )
    columns = [make_smoothing_spline(times, places[:, axis], lam=stiffness).derivative()(elapsed) for axis in range(3)]
    return np.stack(columns, axis=1)


def _on_cubic(times: Array, positions: Array, wanted: Array) -> Array:
    """Positions (M, 3) at other times (M,), on the cubic that fits positions (N, 3), N ≥ 4, best."""
    place: Array = np.polynomial.polynomial.polyval(wanted, np.polynomial.polynomial.polyfit(times, positions, 3)).T
    return place
