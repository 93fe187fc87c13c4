"""What lies in the folders of a data set."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vioframe.checks import Mask
from vioframe.data.selection import check_given
from vioframe.errors import DataError


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
