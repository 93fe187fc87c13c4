"""Told once: a stream that is unlike what was learned from."""

import logging

log = logging.getLogger(__name__)

# By this factor intervals of images may differ from those of the training before it is told.
_SAME_INTERVAL = 1.5


class IntervalCheck:
    """Tells, once a sequence, that images come at another rate than the net has learned from.

    Args:
        learned_s: interval in training, s; zero if there was none.
    """

    def __init__(self, learned_s: float) -> None:
        self._learned_s = learned_s
        self._told = learned_s <= 0.0

    def push(self, interval_s: float) -> None:
        """Take the length of a window, s."""
        if self._told:
            return
        ratio = interval_s / self._learned_s
        if not 1.0 / _SAME_INTERVAL < ratio < _SAME_INTERVAL:
            log.warning(
                "images come every %.3g s, but fuser=lstm has learned from one every %.3g s: its answers may be poor; "
                "train it on recordings of this rate",
                interval_s,
                self._learned_s,
            )
            self._told = True
