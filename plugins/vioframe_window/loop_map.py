"""Maps on disk: places as plain arrays in one ``.npz``, which holds data only and can run nothing."""

import os
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.checks import Array, Stamps, check_array, check_pose
from vioframe.errors import DataError, VioframeError
from vioframe.types import Camera
from vioframe_window.loop_appearance import BYTES, NO_TRACK, Appearance

VERSION = 1

_LARGEST_BYTES = 4 << 30
_ARRAYS: dict[str, tuple[tuple[int | None, ...], type[Any]]] = {
    "stamps_ns": ((None,), np.integer),
    "T_map_body": ((None, 4, 4), np.floating),
    "corner_counts": ((None,), np.integer),
    "pixels": ((None, 2), np.floating),
    "bearings": ((None, 3), np.floating),
    "descriptors": ((None, BYTES), np.uint8),
    "camera_model": ((None,), np.uint8),
    "camera_size_px": ((2,), np.integer),
    "camera_intrinsics_px": ((4,), np.floating),
    "camera_distortion": ((None,), np.floating),
    "T_body_cam": ((4, 4), np.floating),
}
# What an archive raises that is cut off, encrypted, not an archive, or states an array larger than memory.
_UNREADABLE = (zipfile.BadZipFile, zlib.error, ValueError, EOFError, KeyError, RuntimeError, MemoryError, OverflowError)
# Rotation rad and position m by which calibrations of one and the same rig may differ.
_ROTATION_APART, _POSITION_APART_M = 0.05, 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaceMap:
    """Keyframes of an earlier sequence.

    Attributes:
        stamps_ns: (K,).
        T_map_body: (K, 4, 4).
        appearances: K.
    """

    stamps_ns: Stamps
    T_map_body: Array
    appearances: tuple[Appearance, ...]


def save_map(path: Path, places: PlaceMap, camera: Camera) -> None:
    """Write a map; it appears whole or not at all.

    Raises:
        DataError: the file cannot be written.
    """
    arrays = {
        "version": np.array([VERSION]),
        "stamps_ns": places.stamps_ns,
        "T_map_body": places.T_map_body,
        "corner_counts": np.array([len(seen) for seen in places.appearances], dtype=np.int64),
        "pixels": np.concatenate([seen.pixels for seen in places.appearances]).astype(np.float32),
        "bearings": np.concatenate([seen.bearings for seen in places.appearances]).astype(np.float32),
        "descriptors": np.concatenate([seen.descriptors for seen in places.appearances]),
        **_calibration(camera),
    }
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with unfinished.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        unfinished.replace(path)
    except OSError as error:
        raise DataError(f"loop.save_map={path}: the map cannot be written: {error}") from error
    finally:
        unfinished.unlink(missing_ok=True)


def load_map(path: Path, camera: Camera) -> PlaceMap:
    """Read a map.

    Raises:
        DataError: it cannot be read, is of another version or of another rig, or does not hold together.
    """
    what = f"loop.load_map={path}"
    arrays = _read(path, what)
    try:
        for name, (shape, dtype) in _ARRAYS.items():
            check_array(f"{what}: {name}", arrays[name], shape, dtype)
        for name in ("T_map_body", "T_body_cam"):
            check_pose(f"{what}: {name}", arrays[name], tolerance=1e-4)
    except VioframeError as error:
        raise DataError(f"{error}: this file is damaged or no map; save it again") from error
    counts = arrays["corner_counts"]
    held = [len(arrays[name]) for name in ("pixels", "bearings", "descriptors")]
    if len({len(arrays["stamps_ns"]), len(arrays["T_map_body"]), len(counts)}) > 1 or (
        len(counts) and (counts.min() < 0 or set(held) != {int(counts.sum())})
    ):
        raise DataError(f"{what}: its arrays do not fit each other: this file is damaged or no map; save it again")
    _check_rig(what, arrays, camera)
    ends = np.cumsum(counts)
    return PlaceMap(
        stamps_ns=arrays["stamps_ns"].astype(np.int64),
        T_map_body=arrays["T_map_body"].astype(float),
        appearances=tuple(
            Appearance(
                ids=np.full(end - begin, NO_TRACK, dtype=np.int64),
                pixels=arrays["pixels"][begin:end].astype(float),
                bearings=arrays["bearings"][begin:end].astype(float),
                descriptors=arrays["descriptors"][begin:end],
            )
            for begin, end in zip((ends - counts).tolist(), ends.tolist(), strict=True)
        ),
    )


def _read(path: Path, what: str) -> dict[str, np.ndarray]:
    try:
        with zipfile.ZipFile(path) as parts:
            unpacked = sum(part.file_size for part in parts.infolist())
        if unpacked > _LARGEST_BYTES:
            raise DataError(f"{what}: unpacks to {unpacked / 2**30:.1f} GiB, which no map does")
        # Without pickles an array file is numbers; with them it could hold a program.
        with np.load(path, allow_pickle=False) as stored:
            _check_parts(what, stored)
            return {name: stored[name] for name in _ARRAYS}
    except OSError as error:
        raise DataError(f"{what}: cannot be read: {error.strerror or error}") from error
    except _UNREADABLE as error:
        raise DataError(f"{what} is no map of places, or is damaged: {error}") from error


def _check_parts(what: str, stored: Mapping[str, np.ndarray]) -> None:
    version = stored["version"] if "version" in stored else np.zeros(0)
    if version.shape == (1,) and version[0] != VERSION:
        raise DataError(f"{what} is a map of version {version[0]}, but this program reads version {VERSION}")
    missing = [name for name in ("version", *_ARRAYS) if name not in stored]
    if missing or version.shape != (1,):
        raise DataError(f"{what} is no map of places: it has no {[*missing, 'version'][0]}")


def _calibration(camera: Camera) -> dict[str, np.ndarray]:
    return {
        "camera_model": np.frombuffer(camera.model.encode(), dtype=np.uint8),
        "camera_size_px": np.array(camera.size_px),
        "camera_intrinsics_px": camera.intrinsics_px,
        "camera_distortion": camera.distortion,
        "T_body_cam": camera.T_body_cam,
    }


def _check_rig(what: str, stored: dict[str, np.ndarray], camera: Camera) -> None:
    mine = _calibration(camera)

    def refuse(of: str, theirs: object, ours: object) -> None:
        raise DataError(
            f"{what} was made with another rig: its camera 0 has {of} {theirs}, this one's {ours}; "
            "start without the map, or with one of this rig"
        )

    model = bytes(stored["camera_model"]).decode(errors="replace")
    if model != camera.model:
        refuse("model", model, camera.model)
    for of, name, apart in (
        ("size", "camera_size_px", 0.0),
        # Calibrations of one camera differ by a few pixels in a thousand.
        ("intrinsics", "camera_intrinsics_px", 0.02 * float(camera.intrinsics_px[:2].mean())),
        ("distortion", "camera_distortion", 0.05),
    ):
        theirs, ours = stored[name], mine[name]
        if theirs.shape != ours.shape or np.abs(theirs - ours).max(initial=0.0) > apart:
            refuse(of, np.round(theirs, 4).tolist(), np.round(ours, 4).tolist())
    T = np.linalg.inv(stored["T_body_cam"]) @ camera.T_body_cam
    turned = float(np.arccos(np.clip(0.5 * (np.trace(T[:3, :3]) - 1.0), -1.0, 1.0)))
    if turned > _ROTATION_APART or np.linalg.norm(T[:3, 3]) > _POSITION_APART_M:
        refuse(
            "T_body_cam with position",
            np.round(stored["T_body_cam"][:3, 3], 3).tolist(),
            f"{np.round(camera.T_body_cam[:3, 3], 3).tolist()}, turned by {np.degrees(turned):.1f}°",
        )
