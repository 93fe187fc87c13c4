"""What lies in the folders of a data set."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vioframe.checks import Mask
from vioframe.conventions import NANOSECONDS
from vioframe.data.recording import Dataset
from vioframe.data.selection import FrameSelection, check_camera_count, check_given, check_gravity
from vioframe.errors import DataError
from vioframe.types import Camera, ImuNoise, SensorRig


def find_root(root: str | None, key: str) -> Path:
    """The folder of ``dataset.root``.

    Raises:
        ConfigError: not set.
        DataError: not there.
    """
    path = Path(check_given("root", root, f"dataset={key} needs the folder that holds the sequences")).expanduser()
    if not path.is_dir():
        raise DataError(f"{path}: no such folder (dataset.root): check the path, or fetch the data set")
    return path


class FolderDataset(Dataset):
    """The options that all data sets in folders share, with the meaning that their YAML gives them.

    Args:
        key: of the data set in the configuration, for messages.
        root: folder that holds the sequences.
        images: read images; else stamps only.
        cameras: to stream, 1 or 2.
        selection: of frames.
        camera_delay_s: ``t_imu = t_cam + camera_delay_s``.
        gravity: magnitude, m/s².

    Raises:
        ConfigError: names the key.
        DataError: there is no such folder.
    """

    def __init__(
        self,
        *,
        key: str,
        root: str,
        images: bool,
        cameras: int,
        selection: FrameSelection,
        camera_delay_s: float,
        gravity: float,
    ) -> None:
        self.camera_count = check_camera_count(cameras)
        self.gravity = check_gravity(gravity)
        self.root = find_root(root, key)
        self.images = images
        self.selection = selection
        self.camera_delay_ns = round(camera_delay_s * NANOSECONDS)

    def _rig(self, cameras: Sequence[Camera], noise: ImuNoise) -> SensorRig:
        """Calibration of what is streamed, of all cameras that are known."""
        return SensorRig(
            cameras=tuple(cameras[: self.camera_count]),
            imu=noise,
            gravity=self.gravity,
            camera_delay_ns=self.camera_delay_ns,
            has_images=self.images,
        )


def names_in(folder: Path) -> set[str]:
    """Names of what is in a folder; empty where there is none."""
    return {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()


def find_images(paths: Sequence[Sequence[Path]]) -> Mask:
    """Which frames (F,) have the files of all cameras; ``paths`` holds F files a camera.

    Folders are listed once: asking for each of ten thousand files takes seconds on a network disk.
    """
    names = {folder: names_in(folder) for folder in {path.parent for files in paths for path in files}}
    there: Mask = np.array([[path.name in names[path.parent] for path in files] for files in paths], dtype=bool)
    complete: Mask = np.logical_and.reduce(there, axis=0)
    return complete
