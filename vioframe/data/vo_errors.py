"""How a learned or monocular odometer errs: heavy tails, errors that last, a scale that drifts.

The motion that comes out is made of the true one, (R, t) of camera 0 over T seconds, by seven error signals

    R_out = R Exp(T ω),    t_out = exp(s) Exp(δ) t + n,

ω (3) rad/s of rotation, δ (3) rad of the direction of motion, s of the logarithm of the scale, all in camera 0. Each
signal is the sum of two, of which a pair of images sees the mean over its T seconds:

- *white*, of density w: independent from pair to pair with variance w²/T, after Student's t;
- *correlated*: a first-order Gauss-Markov process of standard deviation c and correlation time τ.

Errors are thereby of the same size over a second or a kilometre whatever the frame rate. The small n, white too, is
what an odometer errs by at rest. What is drawn depends on the seed, the recording and the instants of the two images
alone, not on which other images exist.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from vioframe.checks import Array
from vioframe.conventions import NANOSECONDS
from vioframe.errors import ConfigError
from vioframe.geometry import so3

Vector = tuple[float, float, float]

ROTATION, DIRECTION, SCALE = slice(0, 3), slice(3, 6), 6
"""Places of the signals ω, δ and s among the seven."""

# Nodes of the correlated signals, which are linear between them, s; short against every correlation time allowed.
_STEP_S = 0.05
_LEAST_TIME_S = 0.2
# Streams of random numbers of one recording.
_CORRELATED, _WHITE = 0, 1


@dataclass(frozen=True, slots=True, kw_only=True)
class VoErrors:
    """Parameters of the model; see the module.

    Attributes:
        rotation_white: rad/s/√Hz, each axis of camera 0.
        rotation_correlated: rad/s, each axis.
        rotation_time_s: correlation time of all three.
        direction_white: rad/√Hz, turning the direction of motion about each axis of camera 0.
        direction_correlated: rad, about each axis.
        direction_time_s: correlation time of all three.
        scale_white: 1/√Hz, of the logarithm of the scale.
        scale_correlated: of the logarithm of the scale.
        scale_time_s: its correlation time.
        translation_floor: m/√s, each axis, independent of the distance moved.
        tail: degrees of freedom of Student's t of all that is white; above 2, large is Gaussian. What makes one
            pair bad makes it so in all seven.
    """

    rotation_white: Vector
    rotation_correlated: Vector
    rotation_time_s: float
    direction_white: Vector
    direction_correlated: Vector
    direction_time_s: float
    scale_white: float
    scale_correlated: float
    scale_time_s: float
    translation_floor: float
    tail: float

    def __post_init__(self) -> None:
        for name in ("rotation_white", "rotation_correlated", "direction_white", "direction_correlated"):
            value = tuple(float(part) for part in getattr(self, name))
            if len(value) != 3 or not all(part >= 0.0 for part in value):
                raise ConfigError(f"vo.errors.{name} must be three numbers that are not negative, got {list(value)}")
            object.__setattr__(self, name, value)
        for name in ("scale_white", "scale_correlated", "translation_floor"):
            if not getattr(self, name) >= 0.0:
                raise ConfigError(f"vo.errors.{name} must not be negative, got {getattr(self, name)}")
        for name in ("rotation_time_s", "direction_time_s", "scale_time_s"):
            if not getattr(self, name) >= _LEAST_TIME_S:
                raise ConfigError(
                    f"vo.errors.{name} must be {_LEAST_TIME_S} s or more, got {getattr(self, name)}: "
                    "a shorter correlation is white noise"
                )
        if not self.tail > 2.0:
            raise ConfigError(f"vo.errors.tail must be above 2, where the variance is finite, got {self.tail}")

    def scaled(self, rotation: float, translation: float) -> Self:
        """The same shape with all errors of rotation, and all of translation, multiplied."""
        return replace(
            self,
            rotation_white=_times(self.rotation_white, rotation),
            rotation_correlated=_times(self.rotation_correlated, rotation),
            direction_white=_times(self.direction_white, translation),
            direction_correlated=_times(self.direction_correlated, translation),
            scale_white=self.scale_white * translation,
            scale_correlated=self.scale_correlated * translation,
            translation_floor=self.translation_floor * translation,
        )

    @property
    def white(self) -> Array:
        """Densities (7,) of the white parts, in the order ω, δ, s."""
        return np.array([*self.rotation_white, *self.direction_white, self.scale_white])

    @property
    def correlated(self) -> Array:
        """Standard deviations (7,) of the correlated parts."""
        return np.array([*self.rotation_correlated, *self.direction_correlated, self.scale_correlated])

    @property
    def times_s(self) -> Array:
        """Correlation times (7,)."""
        return np.repeat([self.rotation_time_s, self.direction_time_s, self.scale_time_s], [3, 3, 1])

    def spoil(self, T_prev_cur: Array, duration_s: float, signals: Array, floor: Array) -> Array:
        """The motion (4, 4) that comes out.

        Args:
            T_prev_cur: (4, 4) true motion of camera 0.
            duration_s: T.
            signals: (7,) means of the error signals over it.
            floor: (3,) m, in camera 0 at the earlier image.
        """
        spoilt = T_prev_cur.copy()
        spoilt[:3, :3] = T_prev_cur[:3, :3] @ so3.exp(duration_s * signals[ROTATION])
        spoilt[:3, 3] = np.exp(signals[SCALE]) * (so3.exp(signals[DIRECTION]) @ T_prev_cur[:3, 3]) + floor
        return spoilt

    def covariance(self, T_prev_cur: Array, duration_s: float) -> Array:
        """Of one pair's error whatever came before, (6, 6), tangent (rotation, translation), right perturbation.

        To first order in the errors. It cannot tell that errors last: over many pairs they add up to more.

        Args:
            T_prev_cur: (4, 4) motion, true or as it came out.
            duration_s: T.
        """
        variance = self.white**2 / duration_s + self.correlated**2
        lever = so3.hat(T_prev_cur[:3, 3])
        translation = lever @ np.diag(variance[DIRECTION]) @ lever.T
        translation += variance[SCALE] * np.outer(T_prev_cur[:3, 3], T_prev_cur[:3, 3])
        translation += self.translation_floor**2 * duration_s * np.eye(3)
        # Right perturbation: errors are told in the camera at the later image.
        R = T_prev_cur[:3, :3]
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = np.diag(variance[ROTATION] * duration_s**2)
        covariance[3:, 3:] = R.T @ translation @ R
        return covariance


class ErrorCourse:
    """The errors drawn for one recording.

    Args:
        errors: the model.
        start_ns: from where on the correlated signals are drawn; they stay at their first value before.
        end_ns: to where.
        key: numbers, not negative, that name the recording and the seed.
    """

    def __init__(self, errors: VoErrors, start_ns: int, end_ns: int, key: Sequence[int]) -> None:
        from scipy.signal import lfilter

        self._errors = errors
        self._start_ns = start_ns
        self._key = tuple(key)
        nodes = int(np.ceil((end_ns - start_ns) / NANOSECONDS / _STEP_S)) + 2
        draws = np.random.default_rng((*self._key, _CORRELATED)).standard_normal((nodes, 7))
        decay = np.exp(-_STEP_S / errors.times_s)
        draws[1:] *= np.sqrt(1.0 - decay**2)
        course = np.stack([lfilter([1.0], [1.0, -decay[k]], draws[:, k]) for k in range(7)], axis=1)
        self._nodes: Array = course * errors.correlated
        self._integral: Array = np.zeros_like(self._nodes)
        np.cumsum(0.5 * _STEP_S * (self._nodes[1:] + self._nodes[:-1]), axis=0, out=self._integral[1:])

    def draw(self, previous_ns: int, current_ns: int) -> tuple[Array, Array]:
        """Means (7,) of the error signals from one instant to a later one, and the floor (3,) m."""
        duration_s = (current_ns - previous_ns) / NANOSECONDS
        correlated = (self._until(current_ns) - self._until(previous_ns)) / duration_s
        # Stamps may be negative, what seeds a generator may not.
        instants = [stamp_ns & (2**64 - 1) for stamp_ns in (previous_ns, current_ns)]
        random = np.random.default_rng((*self._key, _WHITE, *instants))
        tail = self._errors.tail
        draws = random.standard_normal(10) * np.sqrt((tail - 2.0) / random.chisquare(tail))
        white = self._errors.white / np.sqrt(duration_s) * draws[:7]
        return correlated + white, self._errors.translation_floor * np.sqrt(duration_s) * draws[7:]

    def _until(self, stamp_ns: int) -> Array:
        """Integral (7,) of the correlated signals up to an instant."""
        elapsed = (stamp_ns - self._start_ns) / NANOSECONDS
        place = int(np.clip(elapsed // _STEP_S, 0, len(self._nodes) - 2))
        into = elapsed - place * _STEP_S
        slope = (self._nodes[place + 1] - self._nodes[place]) / _STEP_S
        if elapsed < 0.0:
            slope = np.zeros(7)
        until: Array = self._integral[place] + (self._nodes[place] + 0.5 * slope * into) * into
        return until


def error_signals(T_true: Array, T_estimate: Array, duration_s: Array, least_speed: float) -> Array:
    """The seven signals (P, 7) that make true motions (P, 4, 4) into estimated ones.

    Direction and scale are NaN where the camera moved slower than ``least_speed``, m/s, or the estimate has no length.
    """
    signals = np.full((len(T_true), 7), np.nan)
    R_error = np.swapaxes(T_true[:, :3, :3], -1, -2) @ T_estimate[:, :3, :3]
    signals[:, ROTATION] = so3.log(R_error) / duration_s[:, None]
    true, estimate = T_true[:, :3, 3], T_estimate[:, :3, 3]
    length, length_out = np.linalg.norm(true, axis=1), np.linalg.norm(estimate, axis=1)
    moving = (length > least_speed * duration_s) & (length_out > 0.0)
    axis = np.cross(true[moving], estimate[moving])
    cosine = np.einsum("ni,ni->n", true[moving], estimate[moving])
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, cosine)
    signals[moving, DIRECTION] = axis * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 0.0)[:, None]
    signals[moving, SCALE] = np.log(length_out[moving] / length[moving])
    return signals


def _times(vector: Vector, factor: float) -> Vector:
    return (vector[0] * factor, vector[1] * factor, vector[2] * factor)
