"""``dataset=simulated``: sequences named ``<family>-<seed>``."""

from collections.abc import Iterable, Sequence

from vioframe.conventions import GRAVITY
from vioframe.data.recording import Dataset
from vioframe.data.simulator.cameras import CameraSettings
from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.families import family_traits, plan_motion
from vioframe.data.simulator.imu import ImuSettings
from vioframe.data.simulator.recording import SimulatedRecording
from vioframe.errors import ConfigError, DataError

SEEDS_PER_SPLIT = 10_000
"""Seeds of a split; ``test`` has the first ten thousand, then ``validation``, then ``train``."""

# The motion goes on after the last stamp: for the last rows of a rolling shutter, and the sample that follows.
_AFTERWARDS_S = 1.0
_SPLITS = ("test", "validation", "train")


class SimulatedDataset(Dataset):
    """Simulated sequences of some families and seeds.

    Args:
        sequence: a family, or several.
        seed: number of the sequence within the split, or several.
        split: ``test``, ``validation`` or ``train``: no sequence of one is in another.
        duration_s: length of each; None for the family's own.
        standstill_s: rest at the start; None for the family's own.
        gravity: magnitude, m/s².
        camera: cameras.
        imu: inertial sensor.
        degradations: what spoils the images.

    Raises:
        ConfigError: unknown family or split, a seed outside the split, a duration that is not positive.
    """

    def __init__(
        self,
        *,
        sequence: str | Sequence[str] = "walk",
        seed: int | Sequence[int] = 0,
        split: str = "test",
        duration_s: float | None = None,
        standstill_s: float | None = None,
        gravity: float = GRAVITY,
        camera: CameraSettings | None = None,
        imu: ImuSettings | None = None,
        degradations: Degradations | None = None,
    ) -> None:
        families = [sequence] if isinstance(sequence, str) else list(sequence)
        seeds = list(seed) if isinstance(seed, Iterable) else [seed]
        if not families or not seeds:
            raise ConfigError("dataset.sequence and dataset.seed must name at least one family and one seed")
        if split not in _SPLITS:
            raise ConfigError(f"dataset.split must be one of {', '.join(_SPLITS)}, got {split!r}")
        for family in families:
            family_traits(family)
        for number in seeds:
            if not isinstance(number, int) or not 0 <= number < SEEDS_PER_SPLIT:
                raise ConfigError(f"dataset.seed must be whole numbers from 0 to {SEEDS_PER_SPLIT - 1}, got {number!r}")
        if duration_s is not None and not duration_s > 0.0:
            raise ConfigError(f"dataset.duration_s must be positive, got {duration_s}")
        if standstill_s is not None and not standstill_s >= 0.0:
            raise ConfigError(f"dataset.standstill_s must not be negative, got {standstill_s}")
        if not gravity > 0.0:
            raise ConfigError(f"dataset.gravity must be positive, got {gravity}")
        offset = SEEDS_PER_SPLIT * _SPLITS.index(split)
        self._sequences = {f"{family}-{offset + n}": (family, offset + n) for family in families for n in seeds}
        self._duration_s = duration_s
        self._standstill_s = standstill_s
        self._gravity = gravity
        self._camera = camera or CameraSettings()
        self._imu = imu or ImuSettings()
        self._degradations = degradations or Degradations()

    @property
    def sequences(self) -> Sequence[str]:
        """Names, family by family."""
        return list(self._sequences)

    def open(self, sequence: str) -> SimulatedRecording:
        """Make one sequence.

        Raises:
            DataError: the name is not among :attr:`sequences`.
        """
        if sequence not in self._sequences:
            raise DataError(f"no simulated sequence {sequence!r} here; there are {', '.join(self._sequences)}")
        family, seed = self._sequences[sequence]
        traits = family_traits(family)
        duration_s = traits.duration_s if self._duration_s is None else float(self._duration_s)
        standstill_s = traits.standstill_s if self._standstill_s is None else float(self._standstill_s)
        return SimulatedRecording(
            name=sequence,
            plan=plan_motion(family, seed, duration_s + _AFTERWARDS_S, standstill_s),
            seed=seed,
            duration_s=duration_s,
            kit=traits.kit,
            camera=self._camera,
            imu=self._imu,
            degradations=self._degradations,
            gravity=self._gravity,
        )
