"""A pipeline's windows as a Rerun recording: https://rerun.io/docs."""

import socket
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import se3, so3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.types import Image, Measurement, NavState, SensorRig, Trajectory
from vioframe.viewer import Viewer

TIMELINE = "stamp"
"""Name of the timeline: stamps on the IMU clock."""

_TRUTH_POINTS = 5_000
_MAX_TRUTH_GAP_NS = 200_000_000
_TRUTH_COLOR = (150, 150, 150)
_STATUS_COLORS = {"starting": (255, 187, 51), "tracking": (31, 119, 180), "lost": (214, 39, 40)}
_AXIS_COLORS = ((214, 39, 40), (44, 160, 44), (31, 119, 180))


class RerunViewer(Viewer):
    """Writes ``<folder>/<sequence>.rrd``, or sends to a viewer that runs; options as in ``conf/viewer/rerun.yaml``.

    The world is the estimate's. The truth is moved there once, by the heading and the position that make it
    agree with the first state that is tracked; what separates the two later is drift.
    """

    def __init__(
        self,
        *,
        address: str | None = None,
        every: int = 2,
        image_scale: float = 0.5,
        jpeg_quality: int = 75,
        imu: bool = True,
        timeout_s: float = 2.0,
    ) -> None:
        if find_spec("rerun") is None:
            raise ConfigError(
                "viewer=rerun needs the package rerun-sdk, which is not installed: pip install 'vioframe[viewer]', "
                "or take viewer=none"
            )
        if every < 0:
            raise ConfigError(f"viewer.every must be 0 or more, got {every}")
        if not 0.0 < image_scale <= 1.0:
            raise ConfigError(f"viewer.image_scale must be above 0 and at most 1, got {image_scale}")
        if not 1 <= jpeg_quality <= 100:
            raise ConfigError(f"viewer.jpeg_quality must be from 1 to 100, got {jpeg_quality}")
        if not timeout_s > 0.0:
            raise ConfigError(f"viewer.timeout_s must be positive, got {timeout_s}")
        self._address = address
        self._every = every
        self._scale = image_scale
        self._quality = jpeg_quality
        self._imu = imu
        self._timeout_s = timeout_s
        self._hint = ""
        self._stream: Any = None
        self._truth: Trajectory | None = None
        self._truth_placed = False
        self._windows = 0
        self._last_position: Array | None = None

    @property
    def hint(self) -> str:
        """Command that opens the last file, or the address it was sent to."""
        return self._hint

    def setup(self, sequence: str, rig: SensorRig, ground_truth: Trajectory | None, folder: Path) -> None:
        """Begin a recording, with what does not change over time.

        Raises:
            ConfigError: no viewer answers at the address, or the file cannot be written.
        """
        import rerun as rr

        self.close()
        if self._address is not None:
            check_address(self._address, self._timeout_s)
        stream = rr.RecordingStream("vioframe")
        if self._address is not None:
            stream.connect_grpc(self._address)
            self._hint = self._address
        else:
            path = folder / f"{sequence.replace('/', '_')}.rrd"
            try:
                path.touch()
            except OSError as error:
                raise ConfigError(f"viewer=rerun cannot write {path} ({error.strerror}): set hydra.run.dir") from error
            stream.save(path)
            self._hint = f"rerun {path}"
        self._stream = stream
        self._truth = ground_truth
        self._truth_placed = False
        self._windows = 0
        self._last_position = None
        stream.send_recording_name(sequence)
        stream.send_blueprint(_blueprint(bool(rig.cameras) and rig.has_images and self._every > 0))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._log_rig(rig)
        self._log_legend()

    def watch(self, measurement: Measurement, states: list[NavState]) -> None:
        """Show one window."""
        if self._stream is None:
            raise StateError("RerunViewer.watch was called before setup: set the viewer up first")
        window = measurement.window
        self._at(window.current.stamp_ns)
        # The image of a window without a state yet still belongs on the screen.
        if self._every and self._windows % self._every == 0 and window.current.images:
            self._log_image(measurement, window.current.images[0])
        if self._imu:
            self._log_imu(measurement)
        for state in states:
            self._log_state(state)
        self._windows += 1

    def close(self) -> None:
        """Finish the file, or hang up."""
        if self._stream is None:
            return
        stream, self._stream = self._stream, None
        # A viewer that was closed meanwhile must not hold up the end of the run.
        stream.flush(timeout_sec=self._timeout_s if self._address is not None else 60.0)
        stream.disconnect()

    def _at(self, stamp_ns: int) -> None:
        self._stream.set_time(TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))

    def _log_rig(self, rig: SensorRig) -> None:
        import rerun as rr

        for index, camera in enumerate(rig.cameras):
            fx, fy, cx, cy = camera.intrinsics_px
            width, height = (round(side * self._scale) for side in camera.size_px)
            path = f"world/body/cam{index}"
            T = camera.T_body_cam
            self._stream.log(path, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
            # Rerun's pinhole has no distortion, and counts pixels from the corner of the first one, not its centre.
            pinhole = rr.Pinhole(
                focal_length=(fx * self._scale, fy * self._scale),
                principal_point=((cx + 0.5) * self._scale, (cy + 0.5) * self._scale),
                resolution=(width, height),
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.3,
            )
            self._stream.log(path, pinhole, static=True)

    def _log_legend(self) -> None:
        import rerun as rr

        for name in ("gyro", "accel", "bias_gyro", "bias_accel"):
            style = rr.SeriesLines(colors=_AXIS_COLORS, names=["x", "y", "z"], widths=[1.0, 1.0, 1.0])
            self._stream.log(f"plots/{name}", style, static=True)

    def _log_image(self, measurement: Measurement, image: Image) -> None:
        import rerun as rr

        size = tuple(round(side * self._scale) for side in (image.shape[1], image.shape[0]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if self._scale < 1.0 else image
        if small.ndim == 3:
            small = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
        done, packed = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
        if done:
            self._stream.log("world/body/cam0", rr.EncodedImage(contents=packed.tobytes(), media_type="image/jpeg"))
        tracks = None if measurement.features is None else measurement.features.tracks
        if tracks is None:
            return
        points = rr.Points2D((tracks.pixels + 0.5) * self._scale, colors=track_colors(tracks.ids), radii=2.0)
        self._stream.log("world/body/cam0/tracks", points)
        self._stream.log("plots/tracks", rr.Scalars(float(len(tracks))))

    def _log_imu(self, measurement: Measurement) -> None:
        import rerun as rr

        imu = measurement.window.imu
        if not len(imu):
            return
        # The sample at the end of a window is the first of the next one.
        times = rr.TimeColumn(TIMELINE, timestamp=imu.stamps_ns[1:].astype("datetime64[ns]"))
        for name, values in (("gyro", imu.gyro), ("accel", imu.accel)):
            self._stream.send_columns(f"plots/{name}", indexes=[times], columns=rr.Scalars.columns(scalars=values[1:]))

    def _log_state(self, state: NavState) -> None:
        import rerun as rr

        self._at(state.stamp_ns)
        T = state.T_world_body
        position = T[:3, 3]
        self._stream.log("world/body", rr.Transform3D(translation=position, mat3x3=T[:3, :3]))
        # One piece of the line for each state: the view shows all that lie before its cursor.
        start = position if self._last_position is None else self._last_position
        self._stream.log("world/estimate", rr.LineStrips3D([[start, position]], colors=[_STATUS_COLORS[state.status]]))
        self._last_position = position.copy()
        self._stream.log("plots/speed", rr.Scalars(float(np.linalg.norm(state.v_world_body))))
        self._stream.log("plots/bias_gyro", rr.Scalars(state.bias.gyro))
        self._stream.log("plots/bias_accel", rr.Scalars(state.bias.accel))
        if not self._truth_placed and state.status == "tracking":
            self._place_truth(state)

    def _place_truth(self, state: NavState) -> None:
        import rerun as rr

        if self._truth is None or len(self._truth) < 2:
            return
        T_world_truth = truth_to_estimate(self._truth, state)
        if T_world_truth is None:
            return
        self._truth_placed = True
        line = se3.transform(T_world_truth, thin(self._truth.T_world_body[:, :3, 3], self._truth.stamps_ns))
        self._stream.log("world/ground_truth", rr.LineStrips3D([line], colors=[_TRUTH_COLOR]), static=True)


def truth_to_estimate(truth: Trajectory, state: NavState) -> Array | None:
    """Motion (4, 4) of the truth's world into the estimate's, or None where the truth does not cover the state.

    Both worlds have z up, so that it is a heading and a position: the rotation about z that is nearest to
    ``R_estimate R_truthᵀ``.
    """
    poses, covered = interpolate_poses(truth, np.array([state.stamp_ns], dtype=np.int64), max_gap_ns=_MAX_TRUTH_GAP_NS)
    if not covered[0]:
        return None
    R = state.T_world_body[:3, :3] @ poses[0, :3, :3].T
    heading = so3.exp(np.array([0.0, 0.0, np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])]))
    return se3.from_parts(heading, state.T_world_body[:3, 3] - heading @ poses[0, :3, 3])


def thin(points: Array, stamps_ns: Stamps) -> Array:
    """At most :data:`_TRUTH_POINTS` of the points (N, 3), evenly in time, the first and the last among them."""
    if len(points) <= _TRUTH_POINTS:
        return points
    elapsed_ns = stamps_ns - stamps_ns[0]
    wanted = np.linspace(0, elapsed_ns[-1], _TRUTH_POINTS).astype(np.int64)
    kept: Array = points[np.unique(np.searchsorted(elapsed_ns, wanted))]
    return kept


def track_colors(ids: Stamps) -> np.ndarray:
    """Colours (M, 3) uint8 that stay with their ids (M,) and differ between neighbours."""
    # Steps of the golden ratio spread hues evenly, whatever the number of ids.
    hue = np.mod(ids * 0.618033988749895, 1.0) * 180.0
    hsv = np.stack([hue, np.full(len(ids), 220.0), np.full(len(ids), 255.0)], axis=-1).astype(np.uint8)
    if not len(ids):
        return np.zeros((0, 3), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0], dtype=np.uint8)


def check_address(address: str, timeout_s: float) -> None:
    """Refuse an address where nobody listens; Rerun itself would try in the background for ever.

    Raises:
        ConfigError: not an address of a viewer, or no answer.
    """
    parts = urlsplit(address)
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not parts.scheme.startswith("rerun") or host is None or port is None:
        raise ConfigError(f"viewer.address={address} is not like rerun+http://127.0.0.1:9876/proxy: correct it")
    try:
        socket.create_connection((host, port), timeout=timeout_s).close()
    except OSError as error:
        raise ConfigError(
            f"viewer.address={address}: no viewer answers ({error}): start one with the command rerun, or set "
            "viewer.address=null to write a file"
        ) from error


def _blueprint(images: bool) -> Any:
    """Layout: the world and the image above, plots below."""
    import rerun.blueprint as rrb

    everything_so_far = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    world = rrb.Spatial3DView(name="world", origin="world", overrides={"world/estimate": everything_so_far})
    plots = {
        "gyro, rad/s": ("gyro",),
        "accelerometer, m/s²": ("accel",),
        "gyro bias, rad/s": ("bias_gyro",),
        "accelerometer bias, m/s²": ("bias_accel",),
        "speed, m/s": ("speed",),
        "tracks": ("tracks",),
    }
    views = [
        rrb.TimeSeriesView(name=title, origin="plots", contents=[f"plots/{name}" for name in names])
        for title, names in plots.items()
    ]
    camera = [rrb.Spatial2DView(name="camera 0", origin="world/body/cam0")] if images else []
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(world, *camera, column_shares=[3, 2] if images else [1]),
            rrb.Grid(*views, grid_columns=3),
            row_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
    )
