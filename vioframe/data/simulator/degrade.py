"""What spoils images: each switch alone, all off by default."""

from dataclasses import dataclass

import numpy as np

from vioframe.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Degradations:
    """Switches; every number of ``conf/dataset/simulated.yaml`` under ``degradations``.

    Attributes:
        exposure_ramp: relative brightness swings between ``1 / (1 + x)`` and ``1 + x``.
        exposure_period_s: of the swing.
        flicker: relative brightness changes from frame to frame, standard deviation.
        low_light: 0 … 1: share of the light that is missing; the camera makes up for half of it, with more noise.
        motion_blur_s: exposure time, during which the scene is averaged.
        low_texture: 0 … 1: share of the contrast of surfaces that is missing.
        moving_objects: number of boxes that move through the scene.
        dropped_frames: expected share of frames that never arrive.
        drop_length: mean length of a run of dropped frames.
    """

    exposure_ramp: float = 0.0
    exposure_period_s: float = 8.0
    flicker: float = 0.0
    low_light: float = 0.0
    motion_blur_s: float = 0.0
    low_texture: float = 0.0
    moving_objects: int = 0
    dropped_frames: float = 0.0
    drop_length: float = 1.0

    def __post_init__(self) -> None:
        for name in ("exposure_ramp", "flicker", "motion_blur_s", "moving_objects"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"dataset.degradations.{name} must not be negative, got {getattr(self, name)}")
        for name in ("low_light", "low_texture", "dropped_frames"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ConfigError(f"dataset.degradations.{name} must lie in [0, 1), got {getattr(self, name)}")
        if not self.exposure_period_s > 0.0:
            raise ConfigError(f"dataset.degradations.exposure_period_s must be positive, got {self.exposure_period_s}")
        if not self.drop_length >= 1.0:
            raise ConfigError(f"dataset.degradations.drop_length must be at least 1, got {self.drop_length}")

    def dropped(self, count: int, seed: int) -> np.ndarray:
        """Which of ``count`` frames are lost, (count,) bool; the first and the last always arrive.

        Runs of losses are geometric in length, of mean ``drop_length`` (a Gilbert channel).
        """
        lost = np.zeros(count, dtype=bool)
        if self.dropped_frames == 0.0:
            return lost
        leave = 1.0 / self.drop_length
        enter = leave * self.dropped_frames / (1.0 - self.dropped_frames)
        draws = np.random.default_rng([seed, 10]).uniform(size=count)
        state = False
        for index in range(1, count - 1):
            state = draws[index] >= leave if state else draws[index] < enter
            lost[index] = state
        return lost
