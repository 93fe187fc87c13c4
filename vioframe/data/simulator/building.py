"""The inside of a building: a corridor around a core, with rooms open to it on the outer side."""

import numpy as np

from vioframe.checks import Array
from vioframe.data.simulator import materials
from vioframe.data.simulator.rooms import RoomBuilder
from vioframe.data.simulator.world import WorldPlan

_HALF_WIDTH_M = 1.5
_HEIGHT_M = 2.8
# The finest copy of all walls, blocks included, stays within some fifty million texels.
_TEXELS_PER_METRE = 105.0
_PIECES_A_METRE = 0.25
_DEEPEST_M = 0.42


def build_building(
    rng: np.random.Generator, path: Array, route: Array, *, contrast: float = 1.0, moving: int = 0
) -> WorldPlan:
    """Corridors and rooms along the closed route (M, 3) m of a path (N, 3) m."""
    depth = rng.uniform(2.6, 3.4)
    edge, inside = np.full(2, _HALF_WIDTH_M + depth), np.full(2, _HALF_WIDTH_M)
    low, high = route.min(axis=0)[:2], route.max(axis=0)[:2]
    builder = RoomBuilder(
        rng,
        np.concatenate([path, route]),
        np.array([*(low - edge), 0.0]),
        np.array([*(high + edge), _HEIGHT_M]),
        texels_per_metre=_TEXELS_PER_METRE,
        contrast=contrast,
    )
    builder.build_shell(floor=materials.planks if rng.uniform() < 0.5 else materials.tiles, windows=True)
    builder.prepare_furniture(variety=3)
    for block_low, block_high in _core(rng, low + inside, high - inside):
        builder.add_block(block_low, block_high)
        for axis in (0, 1):
            span = block_low[axis], block_high[axis]
            for at, inward in ((block_low[1 - axis], -1), (block_high[1 - axis], 1)):
                builder.furnish_wall(axis, span, at, inward, per_metre=_PIECES_A_METRE, deepest_m=_DEEPEST_M)
    for block_low, block_high in _outer_blocks(rng, low - inside, high + inside, depth):
        builder.add_block(block_low, block_high)
    for axis in (0, 1):
        span = low[axis], high[axis]
        for at, inward in ((low[1 - axis] - _HALF_WIDTH_M, 1), (high[1 - axis] + _HALF_WIDTH_M, -1)):
            builder.furnish_wall(axis, span, at, inward, per_metre=_PIECES_A_METRE, deepest_m=_DEEPEST_M)
    builder.furnish_walls(0.6)
    builder.furnish_floor(40)
    builder.set_moving(moving)
    return builder.plan


def _block(low: Array, high: Array) -> tuple[Array, Array]:
    return np.array([*low, 0.0]), np.array([*high, _HEIGHT_M])


def _core(rng: np.random.Generator, low: Array, high: Array) -> list[tuple[Array, Array]]:
    """The middle of the house between corners (2,): three blocks in a row with passages between them."""
    cuts = low[0] + (high[0] - low[0]) * np.array([rng.uniform(0.28, 0.38), rng.uniform(0.62, 0.72)])
    half = 0.5 * rng.uniform(1.5, 2.2, 2)
    starts, ends = [low[0], *(cuts + half)], [*(cuts - half), high[0]]
    return [
        _block(np.array([start, low[1]]), np.array([end, high[1]])) for start, end in zip(starts, ends, strict=True)
    ]


def _outer_blocks(rng: np.random.Generator, low: Array, high: Array, depth: float) -> list[tuple[Array, Array]]:
    """Masonry between the corridor's outer edge, given by corners (2,), and the shell; what it leaves are rooms."""
    blocks = []
    for axis in (0, 1):
        reach = depth if axis == 0 else 0.0
        begin, end = low[axis] - reach, high[axis] + reach
        for near, far in ((low[1 - axis] - depth, low[1 - axis]), (high[1 - axis], high[1 - axis] + depth)):
            at = begin
            while at < end:
                length = rng.uniform(2.5, 6.5)
                # No room in a corner, and none that is but a slit.
                stop = end if at + length > end - 6.0 else at + length
                block_low, block_high = np.zeros(2), np.zeros(2)
                block_low[axis], block_high[axis] = at, stop
                block_low[1 - axis], block_high[1 - axis] = near, far
                blocks.append(_block(block_low, block_high))
                at = stop + rng.uniform(2.4, 4.5)
    return blocks
