"""Checks at the door: shape, dtype, finite values, increasing stamps. Each failure says which field."""

from typing import Any

import numpy as np
import numpy.typing as npt

from vioframe.errors import ClockError, ConfigError, ShapeError

Array = npt.NDArray[np.floating]
Stamps = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Image = np.ndarray


def check_array(
    field: str,
    value: object,
    shape: tuple[int | None, ...],
    dtype: type[Any] = np.floating,
    *,
    finite: bool = True,
) -> None:
    """Refuse what is not an array of this shape and kind.

    Args:
        field: what to call it in the message, such as ``"ImuBlock.gyro"``.
        value: the candidate.
        shape: expected shape; ``None`` stands for any length.
        dtype: (abstract) numpy scalar type, such as ``np.floating`` or ``np.uint8``.
        finite: also refuse NaN and infinity.

    Raises:
        ShapeError: with the field, what was expected and what came.
    """
    if not isinstance(value, np.ndarray):
        raise ShapeError(f"{field} must be a numpy array, got {type(value).__name__}")
    if value.ndim != len(shape) or any(
        want is not None and have != want for want, have in zip(shape, value.shape, strict=True)
    ):
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ShapeError(f"{field} must have shape {wanted}, got {value.shape}")
    if not np.issubdtype(value.dtype, dtype):
        raise ShapeError(f"{field} must be of kind {dtype.__name__}, got {value.dtype}")
    if finite and value.dtype.kind == "f" and not np.isfinite(value).all():
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
        raise ShapeError(f"{field} must be finite, got {value[first]} at index {first}")


def check_increasing(field: str, stamps_ns: Stamps) -> None:
    """Refuse stamps that repeat or go back.

    Raises:
        ClockError: with the first offending index and both stamps.
    """
    if stamps_ns.size > 1:
        steps = np.diff(stamps_ns)
        if steps.min() <= 0:
            index = int(np.argmax(steps <= 0))
            how = "repeats" if steps[index] == 0 else "goes back"
            raise ClockError(
                f"{field} must increase strictly, but entry {index + 1} {how}: "
                f"{int(stamps_ns[index])} then {int(stamps_ns[index + 1])} ns"
            )


def check_pose(field: str, T: object, *, tolerance: float = 1e-6) -> None:
    """Refuse what is not a rigid motion, or a stack of them, of shape (..., 4, 4).

    Raises:
        ShapeError: not rigid within ``tolerance`` (deviation of R Rᵀ from the identity, det R > 0).
    """
    if not isinstance(T, np.ndarray) or T.shape[-2:] != (4, 4):
        shape = T.shape if isinstance(T, np.ndarray) else type(T).__name__
        raise ShapeError(f"{field} must have shape (..., 4, 4), got {shape}")
    check_array(field, T, (None,) * T.ndim)
    rotation = T[..., :3, :3]
    deviation = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3))
    if deviation.size and deviation.max() > tolerance:
        raise ShapeError(f"{field} must be a rigid motion, but R Rᵀ is off the identity by {deviation.max():.2g}")
    if rotation.size and (np.linalg.det(rotation) < 0).any():
        raise ShapeError(f"{field} must be a rotation, but its determinant is negative: a mirrored axis")
    if T.size and np.abs(T[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max() > tolerance:
        raise ShapeError(f"{field} must have the last row (0, 0, 0, 1)")


def check_positive(group: str, **values: float) -> None:
    """Refuse options that are not above zero.

    Args:
        group: their place in the config, such as ``"fuser.inertial"``.
        values: by name.

    Raises:
        ConfigError: with the key and its value.
    """
    for name, value in values.items():
        if not value > 0.0:
            raise ConfigError(f"{group}.{name} must be positive, got {value}")


def check_not_negative(group: str, **values: float) -> None:
    """Refuse options below zero; arguments and error as of :func:`check_positive`."""
    for name, value in values.items():
        if not value >= 0.0:
            raise ConfigError(f"{group}.{name} must not be negative, got {value}")
