"""Words for binary descriptors, learned while descriptors come in: nothing is trained beforehand or downloaded."""

import numpy as np

from vioframe.checks import Array
from vioframe_window.loop_appearance import BYTES

LANES = BYTES // 8
"""A descriptor as 64-bit numbers."""

_CLUSTER_ROUNDS = 4
# Descriptors of one point seen again differ by 10 to 40 of 256 bits; a leaf as tight as that is one point.
_TIGHT_BITS = 24.0
# The rarity of words changes slowly.
_REFRESH_LENGTHS = 20


def as_lanes(descriptors: np.ndarray) -> np.ndarray:
    """(N, 4) uint64 of descriptors (N, 32) uint8."""
    return np.ascontiguousarray(descriptors).view(np.uint64).reshape(-1, LANES)


def hamming(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Differing bits of descriptors (..., 4) uint64, broadcast."""
    # Lane by lane: numpy sums over a short last axis ten times as slowly.
    counted: np.ndarray = np.bitwise_count(first[..., 0] ^ second[..., 0]).astype(np.int16)
    for lane in range(1, LANES):
        counted += np.bitwise_count(first[..., lane] ^ second[..., lane])
    return counted


class GrowingTree:
    """A tree of binary words whose leaves divide when they hold too much.

    Nistér & Stewénius, "Scalable recognition with a vocabulary tree", CVPR 2006, with binary centres as in
    Gálvez-López & Tardós, T-RO 2012, grown in place: there the tree is learned from a stock of pictures.

    Args:
        branching: children of a node.
        capacity: descriptors that a leaf may hold before it divides.
        seed: of the first guess at a division.
    """

    def __init__(self, *, branching: int = 8, capacity: int = 60, seed: int = 0) -> None:
        self._branching = branching
        self._capacity = capacity
        self._rng = np.random.default_rng(seed)
        self._centres = np.zeros((1, LANES), dtype=np.uint64)
        self._first_child = np.full(1, -1, dtype=np.int64)
        self._divide_at = np.full(1, capacity, dtype=np.int64)

    @property
    def size(self) -> int:
        """Nodes, of which the leaves are words: words are numbers below this."""
        return len(self._first_child)

    def words(self, lanes: np.ndarray) -> np.ndarray:
        """The leaf (N,) where each descriptor (N, 4) ends."""
        return self._descend(np.zeros(len(lanes), dtype=np.int64), lanes)

    def _descend(self, start: np.ndarray, lanes: np.ndarray) -> np.ndarray:
        node = start.copy()
        inner = np.flatnonzero(self._first_child[node] >= 0)
        while len(inner):
            children = self._first_child[node[inner], None] + np.arange(self._branching)
            distance = hamming(self._centres[children], lanes[inner, None])
            node[inner] = children[np.arange(len(inner)), distance.argmin(axis=1)]
            inner = inner[self._first_child[node[inner]] >= 0]
        return node

    def crowded(self, counts: np.ndarray) -> np.ndarray:
        """Leaves (K,) that hold more of the ``counts`` (size,) descriptors than they may."""
        return np.flatnonzero((counts > self._divide_at) & (self._first_child < 0))

    def divide(self, leaf: int, lanes: np.ndarray) -> np.ndarray | None:
        """Divide a leaf by what it holds (N, 4); the new words (N,), or None where it is better left alone."""
        centres = self._cluster(lanes)
        if centres is None:
            # One and the same point, seen often: ask again when there is twice as much.
            self._divide_at[leaf] = 2 * len(lanes)
            return None
        self._first_child[leaf] = self.size
        self._centres = np.concatenate([self._centres, centres])
        self._first_child = np.concatenate([self._first_child, np.full(len(centres), -1, dtype=np.int64)])
        self._divide_at = np.concatenate([self._divide_at, np.full(len(centres), self._capacity, dtype=np.int64)])
        return self._descend(np.full(len(lanes), leaf, dtype=np.int64), lanes)

    def _cluster(self, lanes: np.ndarray) -> np.ndarray | None:
        """Centres (branching, 4) by k-majority, or None where all are alike."""
        bits = np.unpackbits(lanes.view(np.uint8).reshape(len(lanes), -1), axis=1)
        if np.abs(bits - np.round(bits.mean(axis=0))).sum(axis=1).mean() < _TIGHT_BITS:
            return None
        # Far from those chosen before: k-means++ (Arthur & Vassilvitskii 2007) in bits.
        chosen = [int(self._rng.integers(len(lanes)))]
        nearest = hamming(lanes, lanes[chosen[0]]).astype(float)
        while len(chosen) < self._branching:
            total = float((nearest**2).sum())
            if total == 0.0:
                return None
            chosen.append(int(self._rng.choice(len(lanes), p=nearest**2 / total)))
            nearest = np.minimum(nearest, hamming(lanes, lanes[chosen[-1]]))
        centres = lanes[chosen]
        for _ in range(_CLUSTER_ROUNDS):
            label = hamming(lanes[:, None], centres[None]).argmin(axis=1)
            member = (label[None, :] == np.arange(self._branching)[:, None]).astype(np.float32)
            count = member.sum(axis=1, keepdims=True)
            majority = np.packbits(2.0 * (member @ bits.astype(np.float32)) > count, axis=1)
            centres = np.where(count > 0, as_lanes(majority), centres)
        return centres


class PlaceIndex:
    """Which keyframe holds which words, and which of them looks like a new one (tf-idf, cosine).

    Args:
        branching, capacity: of the tree.
    """

    def __init__(self, *, branching: int = 8, capacity: int = 60) -> None:
        self._tree = GrowingTree(branching=branching, capacity=capacity)
        self._lanes = np.zeros((1024, LANES), dtype=np.uint64)
        self._word = np.zeros(1024, dtype=np.int32)
        self._owner = np.zeros(1024, dtype=np.int32)
        self._ends = np.zeros(1, dtype=np.int64)
        self._held = np.zeros(1, dtype=np.int64)
        self._documents = np.zeros(1, dtype=np.int64)
        self._lengths: Array = np.zeros(0)

    def __len__(self) -> int:
        return len(self._ends) - 1

    def add(self, descriptors: np.ndarray) -> None:
        """The next keyframe holds these descriptors (N, 32)."""
        lanes = as_lanes(descriptors)
        begin, end = int(self._ends[-1]), int(self._ends[-1]) + len(lanes)
        if end > len(self._word):
            room = 2 * end
            self._lanes = np.resize(self._lanes, (room, LANES))
            self._word, self._owner = np.resize(self._word, room), np.resize(self._owner, room)
        words = self._tree.words(lanes)
        self._lanes[begin:end], self._word[begin:end], self._owner[begin:end] = lanes, words, len(self)
        self._ends = np.append(self._ends, end)
        np.add.at(self._held, words, 1)
        self._documents[np.unique(words)] += 1
        for leaf in self._tree.crowded(self._held):
            self._divide(int(leaf), end)

    def _divide(self, leaf: int, end: int) -> None:
        rows = np.flatnonzero(self._word[:end] == leaf)
        words = self._tree.divide(leaf, self._lanes[rows])
        if words is None:
            return
        self._word[rows] = words
        first = len(self._held)
        fresh = np.zeros(self._tree.size - first, dtype=np.int64)
        self._held = np.concatenate([self._held, fresh])
        self._documents = np.concatenate([self._documents, fresh])
        self._held[leaf] = self._documents[leaf] = 0
        np.add.at(self._held, words, 1)
        pairs = np.unique(np.stack([words, self._owner[rows]]), axis=1)
        np.add.at(self._documents, pairs[0], 1)

    def similarity(self, descriptors: np.ndarray) -> Array:
        """How much each keyframe (K,) looks like these descriptors (N, 32), 0 to 1."""
        if not len(self):
            return np.zeros(0)
        words = np.unique(self._tree.words(as_lanes(descriptors)))
        rarity = np.log(len(self) / np.maximum(self._documents, 1.0)) ** 2
        asked = np.zeros(self._tree.size)
        asked[words] = rarity[words]
        end = int(self._ends[-1])
        hits = asked[self._word[:end]]
        rows = np.flatnonzero(hits)
        common = np.bincount(self._owner[rows], hits[rows], minlength=len(self))
        scale = np.sqrt(np.maximum(self._squared_lengths(rarity) * asked.sum(), 1e-12))
        alike: Array = common / scale
        return alike

    def _squared_lengths(self, rarity: Array) -> Array:
        """Of the keyframes' vectors (K,); of all but the newest as they were some keyframes ago, to save time."""
        known = len(self._lengths)
        if known + _REFRESH_LENGTHS < len(self):
            known = 0
        first, end = int(self._ends[known]), int(self._ends[-1])
        weight = rarity[self._word[first:end]]
        fresh = np.bincount(self._owner[first:end] - known, weight, minlength=len(self) - known).astype(float)
        if known == 0:
            self._lengths = fresh
        return np.concatenate([self._lengths[:known], fresh])

    def thin(self, kept: np.ndarray) -> None:
        """Forget the keyframes that are not ``kept`` (K,) bool; the others move up."""
        self._lengths = np.zeros(0)
        end = int(self._ends[-1])
        rows = kept[self._owner[:end]]
        number = np.cumsum(kept) - 1
        counts = np.diff(self._ends)[kept]
        count = int(rows.sum())
        self._lanes[:count] = self._lanes[:end][rows]
        self._word[:count] = self._word[:end][rows]
        self._owner[:count] = number[self._owner[:end][rows]]
        self._ends = np.concatenate([[0], np.cumsum(counts)])
        self._held = np.bincount(self._word[:count], minlength=self._tree.size)
        pairs = np.unique(np.stack([self._word[:count], self._owner[:count]]), axis=1)
        self._documents = np.bincount(pairs[0], minlength=self._tree.size)
