"""A protocol with small pictures."""

from collections.abc import Callable

import pytest

from vioframe.features import FeatureProtocol


@pytest.fixture
def make_protocol() -> Callable[..., FeatureProtocol]:
    """Make a protocol, with any of its values changed."""

    def make(**changes: object) -> FeatureProtocol:
        values: dict[str, object] = {
            "name": "test",
            "width": 320,
            "height": 240,
            "points": 200,
            "suppression_px": 4,
            "border_px": 4,
            "correct_px": 3.0,
            "shared_only": True,
            "max_distance": None,
            "ransac_px": 3.0,
            "ransac_iterations": 2000,
            "ransac_confidence": 0.999,
        }
        return FeatureProtocol(**(values | changes))  # type: ignore[arg-type]

    return make
