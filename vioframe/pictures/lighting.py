"""Other light on the same scene, and what lens, shutter and sensor make of it.

In the order in which light meets them: shading and shadows multiply the light of the scene, the exposure multiplies all
of it, lens and motion blur it, photons and read-out add noise, the sensor clips, and a tone curve and the compression
come last. Pixels stay where they are.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from vioframe.checks import check_not_negative
from vioframe.errors import ConfigError
from vioframe.types import Image

_PROBABILITIES = (
    "shading",
    "shadow",
    "spotlight",
    "vignetting",
    "exposure",
    "tone",
    "low_light",
    "noise",
    "speckle",
    "blur",
    "motion_blur",
    "compression",
)
# Fields of light are drawn small and enlarged.
_COARSE_PX = 8
# Exposure and gain stop where the mean grey value leaves this range: no camera shows less of a scene on purpose.
_MEAN_DN = (9.0, 222.0)
# A small sensor's photo-electrons of a full pixel in good light.
_FULL_WELL = 4000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LightingOptions:
    """How likely each change is, and how strong at most; the defaults are strong in illumination.

    Attributes:
        shading: probability of light that varies smoothly over the picture: a gradient and soft ellipses.
        shading_stops: most, either way, where it is strongest.
        shadow: probability of cast shadows, with edges from hard to soft.
        spotlight: probability of a lamp's or the sun's patch on a scene that is dimmer elsewhere.
        vignetting: probability of corners darker than the middle.
        exposure: probability of another exposure; too much of it clips.
        exposure_stops: most, either way.
        tone: probability of another contrast, gamma and black level.
        contrast: most logarithm of the factor of contrast about the mean.
        gamma: most logarithm of gamma.
        low_light: probability of few photons: a dark scene, amplified in part, with shot and read-out noise.
        low_light_stops: most, of light that is missing.
        noise: probability of Gaussian noise.
        noise_dn: grey values of 255, most standard deviation.
        speckle: probability of noise that grows with the light.
        speckle_share: most standard deviation relative to the light.
        blur: probability of a lens out of focus.
        blur_sigma_px: most standard deviation.
        motion_blur: probability of motion during the exposure.
        motion_blur_px: most length.
        compression: probability of JPEG's traces.
    """

    shading: float = 0.6
    shading_stops: float = 1.6
    shadow: float = 0.25
    spotlight: float = 0.2
    vignetting: float = 0.3
    exposure: float = 0.8
    exposure_stops: float = 1.8
    tone: float = 0.6
    contrast: float = 0.6
    gamma: float = 0.5
    low_light: float = 0.2
    low_light_stops: float = 5.0
    noise: float = 0.5
    noise_dn: float = 10.0
    speckle: float = 0.2
    speckle_share: float = 0.12
    blur: float = 0.25
    blur_sigma_px: float = 1.6
    motion_blur: float = 0.2
    motion_blur_px: float = 8.0
    compression: float = 0.15

    def __post_init__(self) -> None:
        for name in _PROBABILITIES:
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ConfigError(f"{name}={value} of LightingOptions is a probability and must lie in [0, 1]")
        strengths = {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in _PROBABILITIES}
        check_not_negative("LightingOptions", **strengths)

    def without_blur(self) -> "LightingOptions":
        """The same light through a perfect lens and shutter."""
        return replace(self, blur=0.0, motion_blur=0.0)


def change_light(gray: Image, rng: np.random.Generator, options: LightingOptions | None = None) -> Image:
    """The picture in other light.

    Args:
        gray: (H, W) uint8; left as it is.
        rng: generator, which alone decides.
        options: what may happen; the defaults where None.

    Returns:
        (H, W) uint8.
    """
    options = options or LightingOptions()
    light = gray.astype(np.float32)
    happens = {name: bool(rng.random() < getattr(options, name)) for name in _PROBABILITIES}
    if happens["shading"]:
        light *= _smooth_field(rng, gray.shape, options.shading_stops)
    if happens["shadow"]:
        light *= _shadow_field(rng, gray.shape)
    if happens["spotlight"]:
        light *= _spotlight_field(rng, gray.shape)
    if happens["vignetting"]:
        light *= _vignette(rng, gray.shape)
    mean = max(float(light.mean()), 1.0)
    gain = float(2.0 ** rng.uniform(-options.exposure_stops, options.exposure_stops)) if happens["exposure"] else 1.0
    light *= np.clip(gain, min(_MEAN_DN[0] / mean, 1.0), max(_MEAN_DN[1] / mean, 1.0))
    if happens["blur"]:
        light = cv2.GaussianBlur(light, (0, 0), rng.uniform(0.4, max(options.blur_sigma_px, 0.41)))
    if happens["motion_blur"]:
        light = _streak(light, rng.uniform(0.0, np.pi), rng.uniform(2.0, max(options.motion_blur_px, 2.01)))
    if happens["low_light"]:
        _starve(light, rng, options.low_light_stops)
    if happens["noise"]:
        light += np.float32(rng.uniform(0.0, options.noise_dn)) * _white(rng, gray.shape)
    if happens["speckle"]:
        light *= 1.0 + np.float32(rng.uniform(0.0, options.speckle_share)) * _white(rng, gray.shape)
    np.clip(light, 0.0, 255.0, out=light)
    changed: Image = np.rint(light).astype(np.uint8)
    if happens["tone"]:
        changed = _retone(changed, rng, options)
    if happens["compression"]:
        _, code = cv2.imencode(".jpg", changed, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 90))])
        changed = np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return changed


def _white(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.standard_normal(shape, dtype=np.float32)


def _coarse_grid(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates y (h, 1), x (1, w) of a coarse grid, such that the shorter side spans [-1, 1]."""
    rows, columns = (max(n // _COARSE_PX, 8) for n in shape)
    half = 0.5 * min(shape)
    y = np.linspace(-0.5 * shape[0] / half, 0.5 * shape[0] / half, rows, dtype=np.float32)[:, None]
    x = np.linspace(-0.5 * shape[1] / half, 0.5 * shape[1] / half, columns, dtype=np.float32)[None, :]
    return y, x


def _enlarge(field: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    large: np.ndarray = cv2.resize(field, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return large


def _ellipse_distance(y: np.ndarray, x: np.ndarray, rng: np.random.Generator, least: float, most: float) -> np.ndarray:
    """Distance from the centre of a random ellipse in its own radii."""
    centre = rng.uniform(-1.2, 1.2, 2)
    radii = np.exp(rng.uniform(np.log(least), np.log(most), 2))
    angle = rng.uniform(0.0, np.pi)
    along = (np.cos(angle) * (x - centre[0]) + np.sin(angle) * (y - centre[1])) / radii[0]
    across = (np.cos(angle) * (y - centre[1]) - np.sin(angle) * (x - centre[0])) / radii[1]
    distance: np.ndarray = np.hypot(along, across).astype(np.float32)
    return distance


def _smooth_field(rng: np.random.Generator, shape: tuple[int, ...], stops: float) -> np.ndarray:
    """A gradient and some soft ellipses; together no more than ``stops`` either way."""
    y, x = _coarse_grid(shape)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    field = rng.uniform(0.0, 0.7) * (np.cos(angle) * x + np.sin(angle) * y)
    for _ in range(int(rng.integers(0, 5))):
        field = field + rng.uniform(-1.0, 1.0) * np.exp(-(_ellipse_distance(y, x, rng, 0.2, 1.2) ** 2))
    field *= rng.uniform(0.2, 1.0) * stops / max(float(np.abs(field).max()), 1e-3)
    return _enlarge(np.exp2(field).astype(np.float32), shape)


def _shadow_field(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Cast shadows: half planes, bars as of a window's frame, and blobs; penumbras from hard to wide."""
    rows, columns = ((n + 1) // 2 for n in shape)
    lit = np.full((rows, columns), 255, np.uint8)
    kind = rng.integers(3)
    size = max(rows, columns)
    middle = np.array([columns, rows]) * rng.uniform(0.1, 0.9, 2)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    if kind == 0:
        corners = middle + 3 * size * np.array([along, -along, -along + across, along + across])
        cv2.fillPoly(lit, [np.rint(corners).astype(np.int32)], 0)
    elif kind == 1:
        pitch = rng.uniform(0.12, 0.5) * size
        width = rng.uniform(0.2, 0.7) * pitch
        lean = along + rng.uniform(-0.15, 0.15) * across
        for number in range(-12, 13):
            start = middle + number * pitch * across
            corners = start + np.array([-3 * size * along, 3 * size * lean, 3 * size * lean, -3 * size * along])
            corners[2:] += width * across
            cv2.fillPoly(lit, [np.rint(corners).astype(np.int32)], 0)
    else:
        for _ in range(int(rng.integers(1, 7))):
            count = int(rng.integers(4, 12))
            turn = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
            reach = rng.uniform(0.05, 0.4) * size * rng.uniform(0.5, 1.0, count)
            centre = rng.uniform(0.0, 1.0, 2) * (columns, rows)
            corners = centre + reach[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            cv2.fillPoly(lit, [np.rint(corners).astype(np.int32)], 0)
    sigma = float(np.exp(rng.uniform(np.log(0.5), np.log(0.06 * size + 1.0))))
    # A wide blur of a small picture, instead of one with a hundred taps.
    step = max(int(sigma / 2.0), 1)
    small = cv2.resize(lit, (max(columns // step, 2), max(rows // step, 2)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma / step).astype(np.float32)
    depth = float(rng.uniform(0.25, 0.85))
    return _enlarge(1.0 - depth + depth / 255.0 * small, shape)


def _spotlight_field(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    y, x = _coarse_grid(shape)
    distance = _ellipse_distance(y, x, rng, 0.3, 1.0)
    edge = rng.uniform(0.05, 0.5)
    inside = 1.0 / (1.0 + np.exp(np.clip((distance - 1.0) / edge, -30.0, 30.0)))
    dim = rng.uniform(0.15, 0.6)
    return _enlarge((dim + (rng.uniform(1.0, 2.2) - dim) * inside).astype(np.float32), shape)


def _vignette(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """cos⁴ of the angle from the optical axis, for lenses of 20° to 50° at the end of the shorter side."""
    y, x = _coarse_grid(shape)
    tangent = np.tan(np.deg2rad(rng.uniform(20.0, 50.0)))
    return _enlarge((1.0 + tangent**2 * (x**2 + y**2)) ** -2, shape)


def _streak(light: np.ndarray, angle: float, length_px: float) -> np.ndarray:
    """Average along a segment of this length centred on each pixel."""
    half = int(np.ceil(0.5 * length_px))
    offsets = np.linspace(-0.5, 0.5, 4 * half + 1) * length_px
    kernel = np.zeros((2 * half + 3, 2 * half + 3), np.float32)
    px, py = half + 1 + offsets * np.cos(angle), half + 1 + offsets * np.sin(angle)
    column, row = np.floor(px).astype(int), np.floor(py).astype(int)
    right, down = px - column, py - row
    for off_y, off_x, weight in (
        (0, 0, (1 - right) * (1 - down)),
        (0, 1, right * (1 - down)),
        (1, 0, (1 - right) * down),
        (1, 1, right * down),
    ):
        np.add.at(kernel, (row + off_y, column + off_x), weight)
    streaked: np.ndarray = cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT_101)
    return streaked


def _starve(light: np.ndarray, rng: np.random.Generator, stops: float) -> None:
    """Take light away, add the noise of the photons left and of the read-out, and amplify for a part; in place."""
    left = float(2.0 ** -rng.uniform(min(1.0, stops), stops))
    # Automatic gain makes up for two to four fifths, in stops.
    amplified = left ** -rng.uniform(0.4, 0.8)
    amplified = max(amplified, _MEAN_DN[0] / max(left * float(light.mean()), 1e-3))
    light *= np.float32(left)
    variance = np.maximum(light, 0.0) * np.float32(255.0 / _FULL_WELL)
    variance += np.float32(rng.uniform(0.15, 0.6) ** 2)
    light += np.sqrt(variance) * _white(rng, light.shape)
    light *= np.float32(amplified)


def _retone(image: Image, rng: np.random.Generator, options: LightingOptions) -> Image:
    """Contrast about the mean, gamma and black level, by a table."""
    mean = float(image.mean()) / 255.0
    contrast = np.exp(rng.uniform(-options.contrast, options.contrast))
    gamma = np.exp(rng.uniform(-options.gamma, options.gamma))
    black = rng.uniform(0.0, 0.12)
    value = np.clip((np.linspace(0.0, 1.0, 256) - mean) * contrast + mean, 0.0, 1.0) ** gamma
    table = np.rint(255.0 * (black + (1.0 - black) * value)).astype(np.uint8)
    toned: Image = cv2.LUT(image, table)
    return toned
