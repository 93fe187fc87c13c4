"""Pose graph of keyframes in four degrees of freedom: yaw and position.

Roll and pitch are not estimated: a visual-inertial odometry knows them absolutely, to a fraction of a degree
(Qin, Li & Shen, "VINS-Mono", T-RO 2018, section VIII). With the odometry's poses (R_i, o_i), the map's are
``Rz(ψ_i) R_i`` and ``p_i``. An edge says where j is from i, as a displacement d in axes turned like the odometry's at
i, and how much the correction turns between them, κ:

    e = Rz(−ψ_i)(p_j − p_i) − d,    ε = ψ_j − ψ_i − κ.

A step of the odometry has d = o_j − o_i and κ = 0. A match T_i_j has κ = yaw(R_i R_ij R_jᵀ) and
d = Rz(κ) R_j R_ijᵀ t_ij: its own roll and pitch, less sure than the odometry's, do not tilt the displacement.
"""

from dataclasses import dataclass, replace

import numpy as np

from vioframe.checks import Array
from vioframe_window.loop_options import GraphOptions

SIZE = 4
"""Of the error of an edge and the tangent of a node: (yaw rad, x, y, z m)."""

# Radians and metres: a step smaller than this ends the iteration.
_CONVERGED = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges:
    """What ties nodes together.

    Attributes:
        start, end: (E,) nodes i and j.
        displacement: (E, 3) m.
        turn: (E,) rad.
        root: (E, 4) one over the sigmas of (ε, e).
        robust: (E,) whether large errors count linearly.
    """

    start: np.ndarray
    end: np.ndarray
    displacement: Array
    turn: Array
    root: Array
    robust: np.ndarray

    def shifted(self, by: int) -> "Edges":
        """The same between nodes whose numbers are larger."""
        return replace(self, start=self.start + by, end=self.end + by)

    @staticmethod
    def join(first: "Edges", second: "Edges") -> "Edges":
        """Both."""
        return Edges(
            start=np.concatenate([first.start, second.start]),
            end=np.concatenate([first.end, second.end]),
            displacement=np.concatenate([first.displacement, second.displacement]),
            turn=np.concatenate([first.turn, second.turn]),
            root=np.concatenate([first.root, second.root]),
            robust=np.concatenate([first.robust, second.robust]),
        )


def load_solver() -> None:
    """Import the sparse solver now: the first loop closure would else stand still for a fifth of a second."""
    import scipy.sparse.linalg  # noqa: F401


def wrap(angle: Array) -> Array:
    """The same angles (...) rad in (−π, π]."""
    wrapped: Array = np.pi - (np.pi - angle) % (2.0 * np.pi)
    return wrapped


def yaw_of(R: Array) -> Array:
    """Turn (...) rad about z that is nearest to rotations (..., 3, 3)."""
    yaw: Array = np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1])
    return yaw


def errors(yaw: Array, position: Array, edges: Edges) -> Array:
    """Whitened (ε, e), (E, 4), of corrections (N,) rad and positions (N, 3) m."""
    apart = position[edges.end] - position[edges.start]
    turned = _turn_back(yaw[edges.start], apart)
    change = wrap(yaw[edges.end] - yaw[edges.start] - edges.turn)
    whitened: Array = edges.root * np.concatenate([change[:, None], turned - edges.displacement], axis=1)
    return whitened


def jacobians(yaw: Array, position: Array, edges: Edges) -> tuple[Array, Array]:
    """Of the whitened errors with respect to the start and the end, (E, 4, 4) each, columns (ψ, p)."""
    count = len(edges.start)
    cosine, sine = np.cos(yaw[edges.start]), np.sin(yaw[edges.start])
    apart = position[edges.end] - position[edges.start]
    by_start, by_end = np.zeros((count, SIZE, SIZE)), np.zeros((count, SIZE, SIZE))
    by_end[:, 0, 0] = 1.0
    by_end[:, 1, 1] = by_end[:, 2, 2] = cosine
    by_end[:, 1, 2], by_end[:, 2, 1] = sine, -sine
    by_end[:, 3, 3] = 1.0
    by_start -= by_end
    # d/dψ of Rz(−ψ) v is −ẑ × Rz(−ψ) v.
    turned = _turn_back(yaw[edges.start], apart)
    by_start[:, 1, 0], by_start[:, 2, 0] = turned[:, 1], -turned[:, 0]
    return edges.root[..., None] * by_start, edges.root[..., None] * by_end


def _turn_back(yaw: Array, vectors: Array) -> Array:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    x, y, z = vectors.T
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)


def odometry_edges(T_world_body: Array, order: np.ndarray, broken: np.ndarray, options: GraphOptions) -> Edges:
    """Steps from every node to the ``neighbours`` before it.

    Args:
        T_world_body: (N, 4, 4) of the odometry.
        order: (N,) increasing numbers that count steps; some may be missing.
        broken: (N,) whether the step to this node is one that the odometry did not measure.
        options: sigmas.
    """
    count = len(T_world_body)
    ends = np.concatenate([np.arange(k, count) for k in range(1, options.neighbours + 1)])
    starts = np.concatenate([np.arange(max(count - k, 0)) for k in range(1, options.neighbours + 1)])
    position = T_world_body[:, :3, 3]
    displacement = position[ends] - position[starts]
    root_span = np.sqrt(order[ends] - order[starts])
    sigma_m = options.step_sigma_m * root_span + options.step_sigma_share * np.linalg.norm(displacement, axis=1)
    sigma_yaw = np.radians(options.step_sigma_yaw_deg) * root_span
    breaks = np.cumsum(broken)
    across = np.where(breaks[ends] > breaks[starts], options.interrupted, 1.0)
    return Edges(
        start=starts,
        end=ends,
        displacement=displacement,
        turn=np.zeros(len(ends)),
        root=1.0 / (across[:, None] * np.column_stack([sigma_yaw, sigma_m, sigma_m, sigma_m])),
        robust=np.zeros(len(ends), dtype=bool),
    )


def match_edges(start: np.ndarray, end: np.ndarray, T_start_end: Array, sigmas: Array, R: Array) -> Edges:
    """Matches.

    Args:
        start, end: (M,) nodes.
        T_start_end: (M, 4, 4) pose of one body in the other's frame.
        sigmas: (M, 2) rad and m an axis.
        R: (N, 3, 3) rotations of the odometry.
    """
    R_end_start = R[end] @ np.swapaxes(T_start_end[:, :3, :3], -1, -2)
    turn = yaw_of(R[start] @ np.swapaxes(R_end_start, -1, -2))
    apart = (R_end_start @ T_start_end[:, :3, 3:])[..., 0]
    return Edges(
        start=start,
        end=end,
        displacement=_turn_back(-turn, apart),
        turn=turn,
        root=1.0 / sigmas[:, [0, 1, 1, 1]],
        robust=np.ones(len(start), dtype=bool),
    )


def solve(yaw: Array, position: Array, fixed: np.ndarray, edges: Edges, options: GraphOptions) -> tuple[Array, Array]:
    """Corrections (N,) rad and positions (N, 3) m that suit the edges best, from a first guess.

    Gauss–Newton with Huber's weights on the robust edges; ``fixed`` (N,) nodes stay where they are.
    """
    free = np.flatnonzero(~fixed)
    if not len(free):
        return yaw, position
    column = np.full(len(yaw), -1)
    column[free] = np.arange(len(free))
    touching = (column[edges.start] >= 0) | (column[edges.end] >= 0)
    edges = Edges(
        start=edges.start[touching],
        end=edges.end[touching],
        displacement=edges.displacement[touching],
        turn=edges.turn[touching],
        root=edges.root[touching],
        robust=edges.robust[touching],
    )
    yaw, position = yaw.copy(), position.copy()
    blocks = _Blocks(column[edges.start], column[edges.end], len(free))
    for _ in range(options.iterations):
        step = _step(yaw, position, blocks, edges, options.huber)
        yaw[free] += step[:, 0]
        position[free] += step[:, 1:]
        if np.abs(step).max() < _CONVERGED:
            break
    return yaw, position


def _step(yaw: Array, position: Array, blocks: "_Blocks", edges: Edges, huber: float) -> Array:
    """One Gauss–Newton step (count, 4)."""
    error = errors(yaw, position, edges)
    by_start, by_end = jacobians(yaw, position, edges)
    size = np.linalg.norm(error, axis=1)
    weight = np.where(edges.robust & (size > huber), huber / np.maximum(size, huber), 1.0)[:, None, None]
    transposed = np.swapaxes(weight * by_start, 1, 2), np.swapaxes(weight * by_end, 1, 2)
    return blocks.solve(
        [first @ second for first in transposed for second in (by_start, by_end)],
        [-(part @ error[..., None])[..., 0] for part in transposed],
    )


class _Blocks:
    """Where the blocks of the normal equations go; the same in every step.

    Args:
        start, end: (E,) unknown of both ends of every edge, or −1 where it is fixed.
        count: unknowns.
    """

    def __init__(self, start: np.ndarray, end: np.ndarray, count: int) -> None:
        self._count = count
        self._ends = start, end
        pairs = [(first, second) for first in self._ends for second in self._ends]
        self._used = [(first >= 0) & (second >= 0) for first, second in pairs]
        key = np.concatenate(
            [first[used] * count + second[used] for (first, second), used in zip(pairs, self._used, strict=True)]
        )
        self._order = np.argsort(key, kind="stable")
        key = key[self._order]
        self._begins = np.flatnonzero(np.concatenate([[True], np.diff(key) > 0]))
        self._columns = key[self._begins] % count
        self._row_ends = np.searchsorted(key[self._begins] // count, np.arange(count + 1))

    def solve(self, products: list[Array], right: list[Array]) -> Array:
        """Solution (count, 4) from four products (E, 4, 4) of Jacobians and two right-hand sides (E, 4)."""
        from scipy.sparse import bsr_matrix
        from scipy.sparse.linalg import splu

        blocks = np.concatenate([part[used] for part, used in zip(products, self._used, strict=True)])[self._order]
        summed = np.add.reduceat(blocks, self._begins, axis=0)
        size = SIZE * self._count
        normal = bsr_matrix((summed, self._columns, self._row_ends), shape=(size, size)).tocsc()
        total = np.zeros((self._count, SIZE))
        for node, part in zip(self._ends, right, strict=True):
            np.add.at(total, node[node >= 0], part[node >= 0])
        factor = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        solution: Array = factor.solve(total.ravel()).reshape(self._count, SIZE)
        return solution
