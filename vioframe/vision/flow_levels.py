"""Flow on 256 levels, as two-stream networks take it (Simonyan & Zisserman 2014): linear, and nothing stays nothing.

Level 128 is no motion, level 1 is ``-bound_px`` and level 255 is ``bound_px``; what lies further out is cut off.
Kept in pixels, a quantised flow still is a flow; its levels can be had back exactly.
"""

import numpy as np

from vioframe.checks import Array

ZERO_LEVEL = 128
"""Of a component that does not move."""
LEVELS_A_SIDE = 127
"""From no motion to ``bound_px``."""


def flow_to_levels(flow_px: Array, bound_px: float) -> np.ndarray:
    """Levels (...) uint8 of flow components (...) px."""
    levels: np.ndarray = np.clip(np.rint(flow_px * (LEVELS_A_SIDE / bound_px)) + ZERO_LEVEL, 0.0, 255.0)
    return levels.astype(np.uint8)


def levels_to_flow(levels: np.ndarray, bound_px: float) -> Array:
    """Flow components (...) float32 px of levels (...) uint8."""
    flow: Array = (levels.astype(np.float32) - np.float32(ZERO_LEVEL)) * np.float32(bound_px / LEVELS_A_SIDE)
    return flow
