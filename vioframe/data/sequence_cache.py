"""Recordings decoded once for training: images on disk as plain arrays, mapped into memory when they are read.

One shard is one recording, in a folder of its own: ``images.u8`` ((F, H, W, C) bytes, resized, then without loss),
``arrays.npz`` (stamps, poses, inertial samples, calibration) and ``manifest.json``, written last. What learns from the
answers of a VO needs no images: they may be left out. The folder's name is a hash of what went in: the configuration of
the data set, calibration, truth, the first frames' pixels and the inertial samples before them, the size asked for and
the version of this package. The manifest holds a hash of all that came out, which a trained net's card cites.
"""

import errno
import hashlib
import json
import logging
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vioframe import __version__
from vioframe.checks import Array, Mask, Stamps
from vioframe.data.recording import CORRUPT_IMAGES, Recording
from vioframe.data.windows import StoredSequence
from vioframe.errors import ConfigError, DataError, VioframeError
from vioframe.geometry.interpolation import differentiate_positions, interpolate_poses
from vioframe.types import Camera, Image, ImuBlock, Packet, Trajectory

log = logging.getLogger(__name__)

_FORMAT = 2
# Frames whose pixels are part of the key: enough to notice that a folder's images were exchanged.
_FRAMES_IN_KEY = 3
# Truth between poses further apart than this is not invented (as in evaluation.max_gap_s).
_MAX_TRUTH_GAP_NS = 110_000_000
# Share of a recording's images that may be unusable: a damaged file or two, not a folder of another camera.
_MOST_LOST = 0.05
# What a file system needs beside the bytes of the arrays.
_RESERVE = 1.02


class SequenceCache:
    """Decoded recordings below one folder.

    Args:
        folder: created when first needed.
        size_px: (width, height) of the stored images.
        channels: 1 (grey) or 3 (RGB).
        images: False leaves them out, and takes recordings that have none.

    Raises:
        ConfigError: a size that is not positive, or another number of channels.
    """

    def __init__(self, folder: Path, *, size_px: tuple[int, int], channels: int, images: bool = True) -> None:
        if len(size_px) != 2 or min(size_px) < 8:
            raise ConfigError(f"trainer.size_px must be [width, height] of 8 px or more, got {list(size_px)}")
        if channels not in (1, 3):
            raise ConfigError(f"trainer.channels must be 1 (grey) or 3 (RGB), got {channels}")
        self._folder = folder
        self._size_px = (int(size_px[0]), int(size_px[1]))
        self._channels = channels
        self._images = images

    def get(
        self, recording: Recording, source: str, progress: Callable[[int], None] = lambda done: None
    ) -> tuple[StoredSequence, str]:
        """What :func:`read_stored` makes of :meth:`store`, with the errors of both."""
        return read_stored(self.store(recording, source, progress))

    def store(
        self,
        recording: Recording,
        source: str,
        progress: Callable[[int], None] = lambda done: None,
        watch: Callable[[Packet], None] = lambda packet: None,
    ) -> Path:
        """The folder of the stored recording, which is decoded now if it was not before.

        Args:
            recording: opened.
            source: what it was opened from: the resolved configuration of its data set, as text, less what names it.
            progress: told how many frames are done.
            watch: shown every packet, if it is decoded now.

        Raises:
            DataError: no images, no truth, images that cannot be stored, no space on the disk.
        """
        target = self.place(recording, source)
        if not (target / "manifest.json").exists():
            self._write(recording, target, progress, watch)
        return target

    def place(self, recording: Recording, source: str) -> Path:
        """Where :meth:`store` keeps a recording; errors as of there."""
        truth = recording.ground_truth()
        if truth is None or len(truth) < 2:
            raise DataError(f"{recording.name} has no ground truth, so nothing can be learned from it: leave it out")
        if not recording.rig.cameras:
            raise DataError(f"{recording.name} has no camera whose motion could be learned: leave it out")
        if self._images and not recording.rig.has_images:
            raise DataError(f"{recording.name} has no images to learn from: choose rig=mono, or leave it out")
        return self._folder / f"{_clean(recording.name)}-{self._key(recording, source)[:16]}"

    def _key(self, recording: Recording, source: str) -> str:
        truth = recording.ground_truth()
        digest = hashlib.sha256()
        rig = recording.rig
        camera = rig.cameras[0]
        words: list[object] = [
            _FORMAT,
            __version__,
            source,
            recording.name,
            self._size_px,
            self._channels,
            self._images,
            recording.frame_count,
        ]
        words += [camera.model, camera.size_px, rig.gravity, rig.camera_delay_ns, recording.faults()]
        digest.update(json.dumps(words, default=str).encode())
        arrays: list[np.ndarray] = [camera.intrinsics_px, camera.distortion, camera.T_body_cam]
        if truth is not None:
            arrays += [truth.stamps_ns, truth.T_world_body]
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
        frames = 0
        for packet in recording.packets():
            if isinstance(packet, ImuBlock):
                for array in (packet.stamps_ns, packet.gyro, packet.accel):
                    digest.update(np.ascontiguousarray(array).tobytes())
                continue
            digest.update(packet.stamp_ns.to_bytes(8, "little", signed=True))
            for image in packet.images[:1]:
                digest.update(np.ascontiguousarray(image).tobytes())
            frames += 1
            if frames == _FRAMES_IN_KEY:
                break
        return digest.hexdigest()

    def _write(
        self, recording: Recording, target: Path, progress: Callable[[int], None], watch: Callable[[Packet], None]
    ) -> None:
        width, height = self._size_px
        needed = recording.frame_count * width * height * self._channels * self._images
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(self._folder).free
            if needed * _RESERVE > free:
                raise _no_space(self._folder, recording.name, needed, free)
            # In the same folder, so that the renaming at the end happens at once or not at all.
            partial = Path(tempfile.mkdtemp(prefix=".partial-", dir=self._folder))
        except OSError as error:
            raise DataError(f"trainer.cache={self._folder} cannot be written to: {error.strerror}") from error
        try:
            self._fill(recording, partial, progress, watch)
            os.replace(partial, target)
        except OSError as error:
            if (target / "manifest.json").exists():
                # Another run has stored the same recording meanwhile: its copy is as good.
                return
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise _no_space(self._folder, recording.name, needed, shutil.disk_usage(self._folder).free) from error
            raise DataError(f"trainer.cache={self._folder} cannot be written to: {error.strerror}") from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def _fill(
        self, recording: Recording, folder: Path, progress: Callable[[int], None], watch: Callable[[Packet], None]
    ) -> None:
        digest = hashlib.sha256()
        stamps: list[int] = []
        blocks: list[ImuBlock] = []
        size: tuple[int, ...] | None = None
        with (folder / "images.u8").open("wb") as file:
            for packet in recording.packets():
                watch(packet)
                if isinstance(packet, ImuBlock):
                    blocks.append(packet)
                    continue
                stamp_ns = packet.stamp_ns + recording.rig.camera_delay_ns
                if not self._images:
                    stamps.append(stamp_ns)
                    progress(len(stamps))
                    continue
                if not packet.images:
                    continue
                image = packet.images[0]
                if size is not None and image.shape[:2] != size:
                    raise DataError(
                        f"{recording.name}: image {len(stamps)} is {image.shape[1]}×{image.shape[0]} px, those before "
                        f"are {size[1]}×{size[0]}: the images of one recording must all be of one size"
                    )
                size = image.shape[:2]
                pixels = self._convert(image).tobytes()
                file.write(pixels)
                digest.update(pixels)
                stamps.append(stamp_ns)
                progress(len(stamps))
        _check_losses(recording, len(stamps))
        if len(stamps) < 2:
            raise DataError(
                f"{recording.name} has {len(stamps)} image{'' if len(stamps) == 1 else 's'}, but a motion takes two: "
                "give a longer recording"
            )
        arrays = self._arrays(recording, np.array(stamps, dtype=np.int64), blocks)
        for name in sorted(arrays):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(arrays[name]).tobytes())
        np.savez(folder / "arrays.npz", allow_pickle=False, **arrays)
        manifest = {
            "format": _FORMAT,
            "name": recording.name,
            "model": recording.rig.cameras[0].model,
            "size_px": list(self._size_px) if self._images else [0, 0],
            "channels": self._channels,
            "images": len(stamps),
            "sha256": digest.hexdigest(),
        }
        (folder / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")

    def _convert(self, image: Image) -> Image:
        """(H, W, C) at the size of the cache."""
        if image.ndim == 3 and self._channels == 1:
            image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        elif image.ndim == 2 and self._channels == 3:
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        if (image.shape[1], image.shape[0]) != self._size_px:
            # Averaging over the area is what keeps fine texture from turning into patterns.
            image = cv2.resize(image, self._size_px, interpolation=cv2.INTER_AREA)
        return np.asarray(image, dtype=np.uint8).reshape(self._size_px[1], self._size_px[0], self._channels)

    def _arrays(self, recording: Recording, stamps: Stamps, blocks: list[ImuBlock]) -> dict[str, Array | Mask | Stamps]:
        truth = recording.ground_truth()
        if truth is None:
            raise DataError(f"{recording.name} has no ground truth")
        poses, known = interpolate_poses(truth, stamps, max_gap_ns=_MAX_TRUTH_GAP_NS)
        camera = recording.rig.cameras[0]
        if self._images:
            camera = resized_camera(camera, self._size_px)
        T_world_cam = poses @ camera.T_body_cam
        T_world_cam[~known] = np.eye(4)
        return {
            "stamps_ns": stamps,
            "T_world_cam": T_world_cam,
            "known": known,
            "imu_stamps_ns": np.concatenate([np.zeros(0, dtype=np.int64), *(block.stamps_ns for block in blocks)]),
            "gyro": np.concatenate([np.zeros((0, 3)), *(block.gyro for block in blocks)]),
            "accel": np.concatenate([np.zeros((0, 3)), *(block.accel for block in blocks)]),
            "intrinsics_px": camera.intrinsics_px,
            "distortion": camera.distortion,
            "camera_size_px": np.array(camera.size_px),
            "T_body_cam": camera.T_body_cam,
            "gravity": np.array(recording.rig.gravity),
            "truth_stamps_ns": truth.stamps_ns,
            "T_world_body": truth.T_world_body,
            "v_world_body": differentiate_positions(truth),
        }


def resized_camera(camera: Camera, size_px: tuple[int, int]) -> Camera:
    """The calibration after resizing; the centre of the top-left pixel stays (0, 0), so half a pixel moves with it."""
    scale = np.array([size_px[0] / camera.size_px[0], size_px[1] / camera.size_px[1]])
    focal = camera.intrinsics_px[:2] * scale
    centre = (camera.intrinsics_px[2:] + 0.5) * scale - 0.5
    return replace(camera, intrinsics_px=np.concatenate([focal, centre]), size_px=size_px)


def read_stored(folder: Path) -> tuple[StoredSequence, str]:
    """A stored recording, in the folder that :meth:`SequenceCache.store` returned, and the hash of its content.

    Raises:
        DataError: the folder is damaged.
    """
    try:
        manifest: dict[str, Any] = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        width, height = manifest["size_px"]
        shape = (manifest["images"], height, width, manifest["channels"])
        # Nothing cannot be mapped.
        images = (
            np.memmap(folder / "images.u8", np.uint8, "r", shape=shape)
            if width
            else np.zeros((*shape[:3], 1), dtype=np.uint8)
        )
        with np.load(folder / "arrays.npz", allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        imu = ImuBlock(stamps_ns=arrays["imu_stamps_ns"], gyro=arrays["gyro"], accel=arrays["accel"])
        sequence = StoredSequence(
            name=manifest["name"],
            images=images,
            stamps_ns=arrays["stamps_ns"],
            T_world_cam=arrays["T_world_cam"],
            known=arrays["known"],
            imu=imu if len(imu) else None,
            camera=Camera(
                model=manifest["model"],
                intrinsics_px=arrays["intrinsics_px"],
                distortion=arrays["distortion"],
                size_px=tuple(arrays["camera_size_px"].tolist()),
                T_body_cam=arrays["T_body_cam"],
            ),
            gravity=float(arrays["gravity"]),
            truth=Trajectory(
                stamps_ns=arrays["truth_stamps_ns"],
                T_world_body=arrays["T_world_body"],
                v_world_body=arrays["v_world_body"],
            ),
        )
        return sequence, str(manifest["sha256"])
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, VioframeError) as error:
        raise DataError(f"{folder} is damaged ({error}): delete it, and it is made again") from error


def _check_losses(recording: Recording, stored: int) -> None:
    """Refuse a recording of which many images could not be used, and tell of fewer."""
    lost = recording.counters().get(CORRUPT_IMAGES, 0)
    text = f"{recording.name}: {lost} of {lost + stored} images are damaged or of another size than calibrated"
    if lost > _MOST_LOST * (lost + stored):
        raise DataError(f"{text}: fetch them again, take the calibration of these images, or leave the recording out")
    if lost:
        log.warning("%s; they are left out of training", text)


def _clean(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in name)


def _no_space(folder: Path, name: str, needed: int, free: int) -> DataError:
    return DataError(
        f"trainer.cache={folder} has {free / 2**20:.0f} MiB free, but {name} takes {needed / 2**20:.0f} MiB: free some "
        "space, choose another folder, or make trainer.size_px smaller"
    )
