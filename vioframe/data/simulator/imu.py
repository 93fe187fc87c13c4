"""The inertial sensor: exact rates and specific forces, and what a real sensor makes of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.conventions import NANOSECONDS, gravity_vector
from vioframe.data.simulator.spline import Motion
from vioframe.errors import ConfigError
from vioframe.geometry import so3
from vioframe.inertial import walk_sigma, white_sigma
from vioframe.types import ImuBias, ImuBlock, ImuNoise

# Noise is drawn for one second at a time, so that a run and a longer run agree where they overlap.
_CHUNK_S = 1.0


def _triple(key: str, value: Sequence[float]) -> Array:
    values = np.array([float(v) for v in value])
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ConfigError(f"dataset.imu.{key} must be three numbers, got {list(value)}")
    return values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuSettings:
    """An inertial sensor; every number of ``conf/dataset/simulated.yaml`` under ``imu``.

    Measured = ``(1 + scale_error + misalignment) · true + bias + noise``, then saturated and quantised. The
    initial bias is drawn from a normal distribution of the given spread.

    Attributes:
        rate_hz: samples a second.
        gyro_noise: white noise, rad/s/√Hz.
        gyro_walk: bias walk, rad/s²/√Hz.
        accel_noise: white noise, m/s²/√Hz.
        accel_walk: bias walk, m/s³/√Hz.
        gyro_bias_spread: standard deviation of the initial bias, rad/s.
        accel_bias_spread: standard deviation of the initial bias, m/s².
        gyro_scale_error: relative, each axis.
        accel_scale_error: relative, each axis.
        gyro_misalignment: rad, small rotation vector of the sensing axes.
        accel_misalignment: rad, small rotation vector of the sensing axes.
        gyro_limit: saturation, rad/s; 0 for none.
        accel_limit: saturation, m/s²; 0 for none.
        gyro_step: quantisation, rad/s; 0 for none.
        accel_step: quantisation, m/s²; 0 for none.
        jitter_s: standard deviation of the instants of sampling; stamps tell the true instants.
        gaps_s: holes, pairs (start, length) in s since the start.
        random_gaps_per_minute: expected number of further holes.
        random_gap_s: their length, s.
    """

    rate_hz: float = 200.0
    gyro_noise: float = 1.6968e-4
    gyro_walk: float = 1.9393e-5
    accel_noise: float = 2.0e-3
    accel_walk: float = 3.0e-3
    gyro_bias_spread: float = 0.01
    accel_bias_spread: float = 0.05
    gyro_scale_error: Sequence[float] = (0.0, 0.0, 0.0)
    accel_scale_error: Sequence[float] = (0.0, 0.0, 0.0)
    gyro_misalignment: Sequence[float] = (0.0, 0.0, 0.0)
    accel_misalignment: Sequence[float] = (0.0, 0.0, 0.0)
    gyro_limit: float = 0.0
    accel_limit: float = 0.0
    gyro_step: float = 0.0
    accel_step: float = 0.0
    jitter_s: float = 0.0
    gaps_s: Sequence[Sequence[float]] = ()
    random_gaps_per_minute: float = 0.0
    random_gap_s: float = 0.2

    def __post_init__(self) -> None:
        if not self.rate_hz > 0.0:
            raise ConfigError(f"dataset.imu.rate_hz must be positive, got {self.rate_hz}")
        for name in (
            "gyro_noise gyro_walk accel_noise accel_walk gyro_bias_spread accel_bias_spread gyro_limit accel_limit "
            "gyro_step accel_step jitter_s random_gaps_per_minute random_gap_s"
        ).split():
            if not getattr(self, name) >= 0.0:
                raise ConfigError(f"dataset.imu.{name} must not be negative, got {getattr(self, name)}")
        for name in ("gyro_scale_error", "accel_scale_error", "gyro_misalignment", "accel_misalignment"):
            _triple(name, getattr(self, name))
        for gap in self.gaps_s:
            if len(gap) != 2 or gap[0] < 0.0 or gap[1] <= 0.0:
                raise ConfigError(f"dataset.imu.gaps_s must hold pairs (start, length) in s, got {list(gap)}")

    @property
    def noise(self) -> ImuNoise:
        """The densities a rig states."""
        return ImuNoise(
            gyro_noise=self.gyro_noise,
            gyro_walk=self.gyro_walk,
            accel_noise=self.accel_noise,
            accel_walk=self.accel_walk,
            rate_hz=self.rate_hz,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuSamples:
    """Measured samples beside what they hide.

    Attributes:
        block: what the sensor says.
        gyro_bias: (N, 3) rad/s, the truth at each sample.
        accel_bias: (N, 3) m/s², the truth at each sample.
    """

    block: ImuBlock
    gyro_bias: Array
    accel_bias: Array


def exact_imu(motion: Motion, t_s: Array, gravity: float) -> tuple[Array, Array]:
    """Rotation rate (N, 3) rad/s and specific force (N, 3) m/s², body, at times (N,) in s."""
    state = motion.evaluate(t_s)
    R_body_world = np.swapaxes(state.T_world_body[..., :3, :3], -1, -2)
    force = (R_body_world @ (state.acceleration - gravity_vector(gravity))[..., None])[..., 0]
    return state.rotation_rate, force


def _mixing(scale_error: Array, misalignment: Array) -> Array:
    """Matrix (3, 3) from true to measured axes."""
    return np.diag(1.0 + scale_error) @ so3.exp(misalignment)


class InertialSensor:
    """Samples a motion as a real sensor would, one second at a time.

    Args:
        settings: the sensor.
        motion: of the body.
        gravity: magnitude, m/s².
        start_ns: stamp of time zero.
        duration_s: how long to sample; one more sample follows the end.
        seed: of noise, bias, jitter and gaps.
    """

    def __init__(
        self, settings: ImuSettings, *, motion: Motion, gravity: float, start_ns: int, duration_s: float, seed: int
    ) -> None:
        self._settings = settings
        self._motion = motion
        self._gravity = gravity
        self._start_ns = start_ns
        self._duration_s = duration_s
        self._seed = seed

    def gaps(self) -> Array:
        """Holes (G, 2) in s since the start, as (from, to), the random ones included."""
        rng = np.random.default_rng([self._seed, 3])
        count = rng.poisson(self._settings.random_gaps_per_minute * self._duration_s / 60.0)
        starts = np.sort(rng.uniform(0.0, self._duration_s, count))
        holes = [(float(start), float(start) + float(length)) for start, length in self._settings.gaps_s]
        holes += [(float(start), float(start) + self._settings.random_gap_s) for start in starts]
        return np.array(holes).reshape(-1, 2)

    def initial_bias(self) -> ImuBias:
        """The bias at time zero."""
        rng = np.random.default_rng([self._seed, 0])
        return ImuBias(
            gyro=self._settings.gyro_bias_spread * rng.standard_normal(3),
            accel=self._settings.accel_bias_spread * rng.standard_normal(3),
        )

    def stream(self) -> Iterator[ImuSamples]:
        """All samples in order, about a second at a time; holes leave them out."""
        s = self._settings
        gyro_mix = _mixing(
            _triple("gyro_scale_error", s.gyro_scale_error), _triple("gyro_misalignment", s.gyro_misalignment)
        )
        accel_mix = _mixing(
            _triple("accel_scale_error", s.accel_scale_error), _triple("accel_misalignment", s.accel_misalignment)
        )
        bias = self.initial_bias()
        last_gyro_bias, last_accel_bias = bias.gyro, bias.accel
        noise_rng = np.random.default_rng([self._seed, 1])
        jitter_rng = np.random.default_rng([self._seed, 2])
        holes = self.gaps()
        step_s = 1.0 / s.rate_hz
        count = int(np.ceil(self._duration_s * s.rate_hz - 1e-6)) + 2
        chunk = max(round(_CHUNK_S * s.rate_hz), 1)
        for begin in range(0, count, chunk):
            index = np.arange(begin, begin + chunk)
            # Rounded from the index, so that stamps do not drift; jitter never swaps two samples.
            offset = np.clip(s.jitter_s * jitter_rng.standard_normal(chunk), -0.45 * step_s, 0.45 * step_s)
            since_start_ns = np.round((index * step_s + offset) * NANOSECONDS).astype(np.int64)
            draws = noise_rng.standard_normal((chunk, 4, 3))
            # The walk is taken at the nominal steps; jitter would change its spread by far less than itself.
            gyro_steps = walk_sigma(s.gyro_walk, step_s) * draws[:, 0]
            accel_steps = walk_sigma(s.accel_walk, step_s) * draws[:, 1]
            gyro_bias = last_gyro_bias + np.cumsum(gyro_steps, axis=0)
            accel_bias = last_accel_bias + np.cumsum(accel_steps, axis=0)
            last_gyro_bias, last_accel_bias = gyro_bias[-1], accel_bias[-1]
            t_s = since_start_ns / NANOSECONDS
            rate, force = exact_imu(self._motion, t_s, self._gravity)
            noisy_rate = rate @ gyro_mix.T + gyro_bias + white_sigma(s.gyro_noise, step_s) * draws[:, 2]
            noisy_force = force @ accel_mix.T + accel_bias + white_sigma(s.accel_noise, step_s) * draws[:, 3]
            gyro = _digitise(noisy_rate, s.gyro_limit, s.gyro_step)
            accel = _digitise(noisy_force, s.accel_limit, s.accel_step)
            keep = (index < count) & (since_start_ns >= 0)
            for start, end in holes:
                keep &= (t_s < start) | (t_s >= end)
            if not keep.any():
                continue
            yield ImuSamples(
                block=ImuBlock(stamps_ns=self._start_ns + since_start_ns[keep], gyro=gyro[keep], accel=accel[keep]),
                gyro_bias=gyro_bias[keep],
                accel_bias=accel_bias[keep],
            )


def _digitise(values: Array, limit: float, step: float) -> Array:
    """Saturate and round what the converter would."""
    if limit > 0.0:
        values = np.clip(values, -limit, limit)
    if step > 0.0:
        values = np.round(values / step) * step
    return values


class BlockCutter:
    """Cuts a stream of sample blocks at given stamps.

    Args:
        blocks: in order.
    """

    def __init__(self, blocks: Iterator[ImuBlock]) -> None:
        self._source = blocks
        self._rest: ImuBlock | None = next(blocks, None)

    def until(self, stamp_ns: int | None) -> Iterator[ImuBlock]:
        """Samples not later than the stamp (all that are left for None) and not given before."""
        while self._rest is not None:
            block = self._rest
            cut = len(block) if stamp_ns is None else int(np.searchsorted(block.stamps_ns, stamp_ns, side="right"))
            if cut == 0:
                return
            if cut < len(block):
                yield block.cut(0, cut)
                self._rest = block.cut(cut, len(block))
                return
            self._rest = next(self._source, None)
            yield block


def join_stamps(first: Stamps, second: Stamps, *, apart_ns: int) -> Stamps:
    """Both sets of stamps in order, without those of ``first`` that lie within ``apart_ns`` of one of ``second``."""
    position = np.clip(np.searchsorted(second, first), 1, max(len(second) - 1, 1))
    if len(second) == 0:
        return first
    nearest = np.minimum(
        np.abs(first - second[position - 1]), np.abs(first - second[np.minimum(position, len(second) - 1)])
    )
    return np.unique(np.concatenate([first[nearest > apart_ns], second]))
