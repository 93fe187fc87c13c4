import numpy as np
import pytest

from vioframe.vision.flow_levels import ZERO_LEVEL, flow_to_levels, levels_to_flow


@pytest.mark.parametrize("bound_px", [0.5, 20.0, 48.0])
def test_levels_are_linear_and_keep_nothing_as_nothing(bound_px: float) -> None:
    flow = np.linspace(-bound_px, bound_px, 10_001)
    levels = flow_to_levels(flow, bound_px)
    assert levels.dtype == np.uint8
    assert levels.min() == 1 and levels.max() == 255
    assert flow_to_levels(np.zeros(3), bound_px).tolist() == [ZERO_LEVEL] * 3
    assert levels_to_flow(np.array([ZERO_LEVEL], np.uint8), bound_px)[0] == 0.0
    # No value is off by more than half a level, and none of the two sides is favoured.
    again = levels_to_flow(levels, bound_px)
    assert np.abs(again - flow).max() <= 0.5 * bound_px / 127 + 1e-5
    np.testing.assert_array_equal(again, -again[::-1])


def test_levels_come_back_from_pixels_exactly() -> None:
    levels = np.arange(256, dtype=np.uint8)
    for bound_px in (0.3, 7.0, 48.0, 1000.0):
        np.testing.assert_array_equal(flow_to_levels(levels_to_flow(levels, bound_px), bound_px), levels)


def test_what_is_too_long_is_cut_off() -> None:
    np.testing.assert_array_equal(flow_to_levels(np.array([-1e9, -49.0, 49.0, 1e9]), 48.0), [0, 0, 255, 255])
    assert np.isfinite(levels_to_flow(flow_to_levels(np.array([np.inf, -np.inf]), 48.0), 48.0)).all()
