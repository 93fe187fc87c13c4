"""From a detector and a source of pictures to a folder of labelled pictures."""

import logging
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from vioframe.pictures import PictureSource
from vioframe_superpoint.net.inference import fold
from vioframe_superpoint.net.superpoint import SuperPointNet
from vioframe_superpoint.training.adaptation import adapted_heat, points_of
from vioframe_superpoint.training.bar import Bar
from vioframe_superpoint.training.labels import LabelStore
from vioframe_superpoint.training.options import AdaptationOptions
from vioframe_superpoint.training.steps import laid_out

log = logging.getLogger(__name__)

# Pictures of a chunk: a minute or so on one core, which is what a kill costs.
CHUNK = 20
_LABELS = 4


def label_pictures(
    store: LabelStore,
    source: PictureSource,
    net: SuperPointNet,
    options: AdaptationOptions,
    *,
    seed: int,
    precision: str,
    about: Mapping[str, Any],
    until: float | None,
    shown: bool,
) -> bool:
    """Label what is not labelled yet.

    Args:
        store: begun or not.
        source: of the pictures.
        net: the detector.
        options: of the adaptation.
        seed: of the homographies.
        precision: ``32`` or ``bf16``.
        about: what makes the labels, for ``labels.json``.
        until: time, as :func:`time.monotonic` counts, at which to stop; None for no limit.
        shown: whether to show a bar.

    Returns:
        Whether all is done.

    Raises:
        DataError: the folder was begun with something else.
    """
    store.begin(about)
    total = len(source)
    bar = Bar("labels", total, "pictures") if shown else None
    began, made = time.monotonic(), 0
    folded = laid_out(fold(net))
    try:
        for chunk, first in enumerate(range(0, total, CHUNK)):
            if store.has(chunk):
                continue
            if made and until is not None and time.monotonic() >= until:
                return False
            started = time.perf_counter()
            pictures, points, seen = [], [], []
            for index in range(first, min(first + CHUNK, total)):
                picture = source.picture(index)
                rng = np.random.default_rng([seed, _LABELS, index])
                heat, enough = adapted_heat(folded, picture, rng, options, precision)
                pictures.append(picture)
                points.append(points_of(heat, options))
                seen.append(enough)
                made += 1
                if bar is not None:
                    bar.show(index)
                    bar.advance(index + 1, made / max(time.monotonic() - began, 1e-9))
            store.write(chunk, pictures, points, seen, time.perf_counter() - started)
    finally:
        if bar is not None:
            bar.close()
    labelled = store.read()
    counts = [len(each) for each in labelled.points]
    seconds = store.seconds()
    store.tell({"pictures": total, "points_median": float(np.median(counts)), "hours": seconds / 3600.0})
    log.info(
        "%d pictures are labelled, %d points each in the median, in %.1f min: %s",
        total,
        int(np.median(counts)),
        seconds / 60.0,
        store.folder,
    )
    return True
