"""Boxes in perspective: corners where their edges meet."""

import cv2
import numpy as np

from vioframe.checks import Array
from vioframe_superpoint.synthetic.canvas import Canvas, pick_grey

# Corners of the unit box; faces in order around, with normals along -x, x, -y, y, -z, z.
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def draw_boxes(canvas: Canvas) -> None:
    """One to four boxes, some in front of others, with faces of different brightness."""
    rng = canvas.rng
    for _ in range(int(rng.integers(1, 5))):
        corners = _project_box(canvas)
        if corners is None:
            continue
        outline = _outline(corners)
        canvas.cover(outline)
        ground = canvas.contrasting(outline)
        used: list[float] = []
        seen: set[int] = set()
        for face in _FACES:
            polygon = corners[face]
            if _area(polygon) <= 4.0:
                continue
            grey = ground if not used else pick_grey(rng, used, min(canvas.contrast, 45.0))
            canvas.polygon(polygon, grey, seamless=True)
            used.append(float(grey))
            canvas.outline(polygon)
            seen.update(int(k) for k in face)
        canvas.mark(corners[sorted(seen)])


def _project_box(canvas: Canvas) -> Array | None:
    """Corners (8, 2) px of a turned box; None where it comes too close to the camera."""
    rng = canvas.rng
    half = rng.uniform(0.25, 1.0, 3)
    matrix, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    matrix[:, 0] *= np.sign(np.linalg.det(matrix))
    distance = rng.uniform(3.0, 9.0)
    points = (_CORNERS * half) @ matrix.T + np.array([0.0, 0.0, distance])
    if points[:, 2].min() < 1.0:
        return None
    spread = points[:, :2] / points[:, 2:]
    size = canvas.side * rng.uniform(0.25, 1.1) / float(np.ptp(spread, axis=0).max())
    placed: Array = size * spread + canvas.somewhere(1, margin=0.12 * canvas.side)[0]
    return placed


def _area(polygon: Array) -> float:
    """Signed area in px² of a face; positive where it is turned towards the camera."""
    x, y = polygon.T
    return -0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def _outline(corners: Array) -> Array:
    """Convex hull (N, 2) px, in order."""
    hull: Array = cv2.convexHull(corners.astype(np.float32))[:, 0].astype(np.float64)
    return hull
