"""The observations that have not been used yet, in one dense table."""

import numpy as np

from vioframe.checks import Array, Mask, Stamps


class TrackTable:
    """Observations by track, camera of the rig and clone; a weight of zero is no observation.

    Columns follow the clones: the first is the oldest one's.

    Args:
        cameras: cameras of the rig, 1 or 2.
        columns: most clones.
    """

    def __init__(self, cameras: int, columns: int) -> None:
        self.ids: Stamps = np.zeros(0, dtype=np.int64)
        self.points: Array = np.zeros((0, cameras, columns, 2))
        self.weights: Array = np.zeros((0, cameras, columns))
        self.seen: Mask = np.zeros(0, dtype=bool)
        """Whether a track is in the newest image."""

    def __len__(self) -> int:
        return len(self.ids)

    def begin_image(self) -> None:
        """No track is in the newest image, until it is added."""
        self.seen[:] = False

    def add(self, camera: int, column: int, ids: Stamps, points: Array, weights: Array) -> None:
        """Enter one image's observations.

        Args:
            camera: of the rig; what camera 1 sees is entered after camera 0 only.
            column: the clone's.
            ids: (M,) of the tracks; those unknown to camera 0 begin here.
            points: (M, 2) on the normalised plane.
            weights: (M,) 1/σ.
        """
        rows, known = self.find(ids)
        if camera == 0 and not known.all():
            self._extend(ids[~known])
            rows, known = self.find(ids)
        rows = rows[known]
        self.points[rows, camera, column] = points[known]
        self.weights[rows, camera, column] = weights[known]
        if camera == 0:
            self.seen[rows] = True

    def keep_alive(self, ids: Stamps) -> None:
        """These tracks are in the newest image, though what was seen there is not entered."""
        rows, known = self.find(ids)
        self.seen[rows[known]] = True

    def find(self, ids: Stamps) -> tuple[Stamps, Mask]:
        """Rows (M,) of tracks, and whether each is known."""
        return find_sorted(self.ids, ids)

    def drop_rows(self, drop: Mask) -> None:
        """Forget tracks, (T,)."""
        keep = ~drop
        self.ids, self.seen = self.ids[keep], self.seen[keep]
        self.points, self.weights = self.points[keep], self.weights[keep]

    def drop_column(self, column: int) -> None:
        """Forget what was seen from one clone, and the tracks that nothing is left of."""
        self.points[:, :, column:-1] = self.points[:, :, column + 1 :]
        self.weights[:, :, column:-1] = self.weights[:, :, column + 1 :]
        self.weights[:, :, -1] = 0.0
        empty = np.asarray(~self.weights.any(axis=(1, 2)))
        if empty.any():
            self.drop_rows(empty)

    def _extend(self, ids: Stamps) -> None:
        _, cameras, columns, _ = self.points.shape
        count = len(ids)
        joined = np.concatenate([self.ids, ids])
        order = np.argsort(joined, kind="stable")
        self.ids = joined[order]
        self.points = np.concatenate([self.points, np.zeros((count, cameras, columns, 2))])[order]
        self.weights = np.concatenate([self.weights, np.zeros((count, cameras, columns))])[order]
        self.seen = np.concatenate([self.seen, np.zeros(count, dtype=bool)])[order]


def find_sorted(ordered: Stamps, wanted: Stamps) -> tuple[Stamps, Mask]:
    """Places (M,) of ``wanted`` in ``ordered`` (ascending), and whether each is there."""
    if not len(ordered):
        return np.zeros(len(wanted), dtype=np.int64), np.zeros(len(wanted), dtype=bool)
    places = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
    return places, ordered[places] == wanted
