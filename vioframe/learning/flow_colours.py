"""Flow as colours: the direction is the hue, the length how strong it is; white stands still."""

import math

import numpy as np

from vioframe.checks import Array


def flow_colours(flow: Array, radius_px: float) -> Array:
    """RGB (H, W, 3) in [0, 1] of a flow (H, W, 2) px; longer than ``radius_px`` is darker than the strongest hue."""
    from matplotlib.colors import hsv_to_rgb

    length = np.linalg.norm(flow, axis=-1) / radius_px
    # Rightward is red, as an angle of zero.
    hue = np.arctan2(flow[..., 1], flow[..., 0]) / (2.0 * math.pi) % 1.0
    dimmed = np.where(length > 1.0, 1.0 / np.maximum(length, 1.0) ** 0.5, 1.0)
    # Half the length is more than half the strength: most of a road's flow is short.
    strength = np.clip(length, 0.0, 1.0) ** 0.6
    colours: Array = hsv_to_rgb(np.stack([hue, strength, dimmed], axis=-1))
    return colours


def colour_wheel(pixels: int) -> Array:
    """The legend: RGB (pixels, pixels, 3) of a disc whose rim has the length of ``radius_px``; white around it."""
    place = np.linspace(-1.0, 1.0, pixels)
    flow = np.stack(np.meshgrid(place, place), axis=-1)
    wheel = flow_colours(flow, 1.0)
    wheel[np.linalg.norm(flow, axis=-1) > 1.0] = 1.0
    return wheel


def wheel_radius(flow: Array) -> float:
    """A round number of px, 1, 2, 3 or 5 times a power of ten, that 99 of 100 flows (H, W, 2) stay below."""
    usual = float(np.quantile(np.linalg.norm(flow, axis=-1), 0.99))
    if not math.isfinite(usual) or usual <= 0.1:
        return 0.1
    power = 10.0 ** math.floor(math.log10(usual))
    # Rounding must not turn 2 into 3.
    return next(step * power for step in (1.0, 2.0, 3.0, 5.0, 10.0) if step * power >= usual * (1.0 - 1e-9))
