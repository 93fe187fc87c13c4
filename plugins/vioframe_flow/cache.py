"""Flows on disk, each under the content of its two images and the settings that made it.

An entry is the bytes of an array, whose shape the reader knows, and a digest of it. It is written beside its place
and then moved there, so that several processes may share a folder and a kill leaves no half entry; what is damaged
all the same is computed again.
"""

import logging
import math
import os
import tempfile
from hashlib import blake2b
from pathlib import Path

import numpy as np

from vioframe.errors import DataError

log = logging.getLogger(__name__)

_DIGEST_BYTES = 16


class FlowCache:
    """Flows of image pairs.

    Args:
        folder: made if it does not exist.
        settings: all that the flow of a pair depends on beside the images, as text.

    Raises:
        DataError: the folder cannot be made.
    """

    def __init__(self, folder: str, settings: str) -> None:
        self._folder = Path(folder).expanduser()
        self._settings = settings.encode()
        self.hits = 0
        self.misses = 0
        self.damaged = 0
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._refusal(f"cannot be made a folder: {error.strerror}") from error

    @staticmethod
    def digest(array: np.ndarray) -> bytes:
        """What stands for an image or a flow: its shape, kind and bytes."""
        return blake2b(f"{array.shape} {array.dtype} ".encode() + array.tobytes(), digest_size=_DIGEST_BYTES).digest()

    def key(self, first: bytes, second: bytes) -> str:
        """Of the flow from one image, given by its digest, to another."""
        return blake2b(first + second + self._settings, digest_size=_DIGEST_BYTES).hexdigest()

    def load(self, key: str, shape: tuple[int, ...], dtype: type[np.generic]) -> np.ndarray | None:
        """The array stored under ``key``, or None where there is none, or none that is whole."""
        try:
            content = self._path(key).read_bytes()
        except FileNotFoundError:
            self.misses += 1
            return None
        except OSError as error:
            raise self._refusal(f"cannot be read: {error.strerror}") from error
        body, digest = content[:-_DIGEST_BYTES], content[-_DIGEST_BYTES:]
        if len(body) == math.prod(shape) * np.dtype(dtype).itemsize:
            array: np.ndarray = np.frombuffer(body, dtype).reshape(shape).copy()
            if self.digest(array) == digest:
                self.hits += 1
                return array
        self.misses += 1
        self.damaged += 1
        log.warning("flow cache: %s is damaged and will be computed again", self._path(key))
        return None

    def store(self, key: str, array: np.ndarray) -> None:
        """Keep an array under ``key``.

        Raises:
            DataError: there is no space, or the folder cannot be written.
        """
        path = self._path(key)
        temporary = ""
        try:
            path.parent.mkdir(exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
                temporary = file.name
                file.write(array.tobytes() + self.digest(array))
            os.replace(temporary, path)
        except OSError as error:
            if temporary:
                Path(temporary).unlink(missing_ok=True)
            raise self._refusal(
                f"cannot take another flow of {array.nbytes / 1024:.0f} KiB ({error.strerror}): free some space"
            ) from error

    def _path(self, key: str) -> Path:
        # A folder with a hundred thousand entries is slow on many file systems.
        return self._folder / key[:2] / f"{key[2:]}.flow"

    def _refusal(self, what: str) -> DataError:
        return DataError(f"frontend.cache={self._folder} {what}, choose another folder, or use frontend.cache=null")
