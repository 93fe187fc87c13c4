"""What of KITTI's odometry benchmark lies in a folder, and what to do where some of it does not."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vioframe.errors import DataError
from vioframe_recordings.folders import names_in
from vioframe_recordings.kitti_calibration import odometry_drive


@dataclass(frozen=True, slots=True, kw_only=True)
class Inventory:
    """What a run reads of each sequence.

    Attributes:
        root: folder of the data set.
        images: whether images are read.
        cameras: of how many cameras.
        color: of the colour cameras.
        imu: whether inertial samples are read.
    """

    root: Path
    images: bool
    cameras: int
    color: bool
    imu: bool

    def image_folders(self, name: str) -> list[Path]:
        """One for each camera."""
        first = 2 if self.color else 0
        return [self.root / "sequences" / name / f"image_{first + index}" for index in range(self.cameras)]

    def imu_file(self, name: str) -> Path:
        """File of inertial samples."""
        return self.root / "imus_100hz_mat" / f"{name}.mat"

    def lacking(self, name: str) -> list[str]:
        """What of a sequence is not there, relative to the root."""
        folder = self.root / "sequences" / name
        if not folder.is_dir():
            return [f"sequences/{name}"]
        wanted = [*(self.image_folders(name) if self.images else ()), *((self.imu_file(name),) if self.imu else ())]
        return [str(path.relative_to(self.root)) for path in wanted if not path.exists()]

    def complete(self) -> list[str]:
        """Sequences that can be read."""
        there = sorted(names_in(self.root / "sequences"))
        return [name for name in there if odometry_drive(name) is not None and not self.lacking(name)]

    def check(self, asked: Sequence[str]) -> None:
        """Refuse sequences that are not there, before the first is read, let alone trained on.

        Raises:
            DataError: names all that is missing, and what could be run instead.
        """
        lacking = {name: found for name in asked if (found := self.lacking(name))}
        if lacking:
            files = ", ".join(found for each in lacking.values() for found in each)
            raise DataError(
                f"{self.root} lacks {files}, for the sequences {', '.join(asked)}: fetch {_them(lacking)}"
                f"{self._instead(asked)}"
            )

    def find(self) -> list[str]:
        """All sequences that can be read.

        Raises:
            DataError: there is none.
        """
        names = self.complete()
        if not names:
            example = replace(self, root=Path("."))
            wanted = [*(example.image_folders("01") if self.images else [Path("sequences/01")])]
            wanted += [example.imu_file("01")] if self.imu else []
            raise DataError(
                f"{self.root}: no sequence here ({', '.join(map(str, wanted))}, say, are expected): set dataset.root"
                f"{self._instead(())}"
            )
        return names

    def _instead(self, asked: Sequence[str]) -> str:
        """The end of a sentence: options with which some sequences can be read, preferably of those asked for."""
        for option, other in self._others():
            there = other.complete()
            chosen = [name for name in asked if name in there] or there
            if chosen:
                numbers = ",".join(str(int(name)) for name in chosen)
                return (
                    f", or run on what is there: {option}dataset.sequence=[{numbers}] (training_data.sequence where it "
                    "is to train on)"
                )
        return ""

    def _others(self) -> "Iterator[tuple[str, Inventory]]":
        """What asks for less, the least change first, as it would be written on the command line."""
        yield "", self
        if self.images:
            yield f"dataset.color={str(not self.color).lower()} ", replace(self, color=not self.color)
            if self.cameras > 1:
                yield "rig=mono ", replace(self, cameras=1)
        if self.imu:
            yield "dataset.imu=none ", replace(self, imu=False)
            if self.images:
                color = f"dataset.color={str(not self.color).lower()} "
                yield f"{color}dataset.imu=none ", replace(self, color=not self.color, imu=False)
        if self.images:
            yield "dataset.images=false ", replace(self, images=False)


def _them(lacking: dict[str, list[str]]) -> str:
    return "it" if sum(map(len, lacking.values())) == 1 else "them"
