"""Samples of a window whose ends may lie in a hole."""

import numpy as np

from vioframe.checks import Array, Stamps
from vioframe.types import ImuBlock

# A window that lies in a hole by more than this share of its length has no samples worth the name.
_MOST_MISSING = 0.5


def held_samples(samples: ImuBlock, start_ns: int, end_ns: int, bridge_ns: int) -> tuple[ImuBlock, int]:
    """Samples from ``start_ns`` to ``end_ns`` with one exactly at both, and the longest time without any, ns.

    An end is interpolated between the samples around it unless these are further apart than ``bridge_ns`` or one of
    them is not there; it then keeps the value of the sample next to it inside the window. Of such a hole only what
    lies inside the window is told, so a window does not depend on when the samples come back.

    Args:
        samples: all that are known around the window; none is fine.
        start_ns: of the window.
        end_ns: of the window.
        bridge_ns: longest hole that is interpolated across.

    Returns:
        an empty block where more than half of the window lies in such holes.
    """
    stamps_ns = samples.stamps_ns
    first = int(np.searchsorted(stamps_ns, start_ns, side="left"))
    last = int(np.searchsorted(stamps_ns, end_ns, side="right")) - 1
    inside_ns = stamps_ns[first : last + 1]
    before = first - 1 if first > 0 else None
    after = last + 1 if last + 1 < len(stamps_ns) else None
    if not len(inside_ns):
        if before is None or after is None or stamps_ns[after] - stamps_ns[before] > bridge_ns:
            return ImuBlock.none(), end_ns - start_ns
        values = np.stack([_at(samples, before, start_ns), _at(samples, before, end_ns)])
        return _block(np.array([start_ns, end_ns]), values), int(stamps_ns[after] - stamps_ns[before])

    spacings = np.diff(inside_ns)
    gaps, missing_ns = [int(spacings.max(initial=0))], int(spacings[spacings > bridge_ns].sum())
    stamps, values = (
        inside_ns,
        np.concatenate([samples.gyro[first : last + 1], samples.accel[first : last + 1]], axis=1),
    )
    if inside_ns[0] > start_ns:
        bridged = before is not None and inside_ns[0] - stamps_ns[before] <= bridge_ns
        end = _at(samples, first - 1, start_ns) if bridged else values[0]
        stamps, values = np.concatenate([[start_ns], stamps]), np.concatenate([end[None], values])
        gaps.append(int(inside_ns[0] - (stamps_ns[first - 1] if bridged else start_ns)))
        missing_ns += 0 if bridged else gaps[-1]
    if inside_ns[-1] < end_ns:
        bridged = after is not None and stamps_ns[after] - inside_ns[-1] <= bridge_ns
        end = _at(samples, last, end_ns) if bridged else values[-1]
        stamps, values = np.concatenate([stamps, [end_ns]]), np.concatenate([values, end[None]])
        gaps.append(int((stamps_ns[last + 1] if bridged else end_ns) - inside_ns[-1]))
        missing_ns += 0 if bridged else gaps[-1]
    if missing_ns > _MOST_MISSING * (end_ns - start_ns):
        return ImuBlock.none(), max(gaps)
    return _block(stamps, values), max(gaps)


def _at(samples: ImuBlock, before: int, stamp_ns: int) -> Array:
    """Gyro and accel, (6,), at a stamp between the samples ``before`` and ``before + 1``."""
    early_ns, late_ns = samples.stamps_ns[before], samples.stamps_ns[before + 1]
    early, late = (np.concatenate([samples.gyro[k], samples.accel[k]]) for k in (before, before + 1))
    value: Array = early + float(stamp_ns - early_ns) / float(late_ns - early_ns) * (late - early)
    return value


def _block(stamps_ns: Stamps, values: Array) -> ImuBlock:
    return ImuBlock(stamps_ns=stamps_ns, gyro=values[:, :3], accel=values[:, 3:])
