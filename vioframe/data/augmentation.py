"""Changes to training windows that keep image and motion consistent; every one is drawn from the generator given.

Geometric ones change motion, inertial samples and calibration with the images, exactly:

- reversed: time runs backwards. With t' = t_first + t_last - t the motion of a pair becomes its inverse, rotation rates
  and velocities change sign and specific force, being even in time, does not; an error n of a VO's motion, T Exp(n), is
  -Ad(T) n of the inverse;
- mirrored left to right: with M = diag(-1, 1, 1) in the camera, ``T' = M T M`` (on the 4×4 matrix, M acts on the first
  three axes). The body is mirrored at the same plane, by B = R_bc M R_bcᵀ, so that its mounting keeps its rotation,
  ``T'_body_cam = (R_bc, B p)``; specific force, velocity and gravity, vectors, become B a, and rotation rate, an axial
  one, -B ω; an error (φ, ρ) of a VO's motion becomes (-M φ, M ρ).

The others change pixels only: Gaussian blur and salt and pepper as in Zhao et al. 2022, and brightness, contrast and
gamma, which a window shares, since a camera's exposure changes slowly. What is done to stamps and inertial samples is
in :mod:`vioframe.data.desync`.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from vioframe.checks import Array, check_not_negative
from vioframe.data.desync import Desynchronisation
from vioframe.data.windows import PairAnswers, TrainingWindow
from vioframe.errors import ConfigError
from vioframe.geometry import se3
from vioframe.types import Image

_MIRROR = np.diag([-1.0, 1.0, 1.0])


class Augmentation:
    """What happens to a training window, each change with its own probability.

    Args:
        reverse: probability of running the window backwards.
        mirror: probability of mirroring it left to right.
        blur: probability of Gaussian blur.
        blur_sigma_px: (least, most) standard deviation of the blur.
        salt_pepper: probability of salt and pepper.
        salt_pepper_share: most share of pixels that become black or white.
        photometric: probability of a change of brightness, contrast and gamma.
        brightness: most relative change of brightness.
        contrast: most relative change of contrast about the mean.
        gamma: most change of the logarithm of gamma.
        sensors: how far sensors are out of step, or None; takes effect where windows are cut, before all others.

    Attributes:
        sensors: the same.

    Raises:
        ConfigError: a probability outside [0, 1], a negative size.
    """

    def __init__(
        self,
        *,
        reverse: float,
        mirror: float,
        blur: float,
        blur_sigma_px: Sequence[float],
        salt_pepper: float,
        salt_pepper_share: float,
        photometric: float,
        brightness: float,
        contrast: float,
        gamma: float,
        sensors: Desynchronisation | None = None,
    ) -> None:
        chances = {
            "reverse": reverse,
            "mirror": mirror,
            "blur": blur,
            "salt_pepper": salt_pepper,
            "salt_pepper_share": salt_pepper_share,
            "photometric": photometric,
        }
        for name, value in chances.items():
            if not 0.0 <= value <= 1.0:
                raise ConfigError(f"trainer.augmentation.{name} must lie in [0, 1], got {value}")
        check_not_negative("trainer.augmentation", brightness=brightness, contrast=contrast, gamma=gamma)
        sigmas = tuple(float(sigma) for sigma in blur_sigma_px)
        if len(sigmas) != 2 or not 0.0 < sigmas[0] <= sigmas[1]:
            raise ConfigError(
                f"trainer.augmentation.blur_sigma_px must be [least, most] above zero, got {list(blur_sigma_px)}"
            )
        self._reverse = reverse
        self._mirror = mirror
        self._blur = blur
        self._sigmas = sigmas
        self._salt_pepper = salt_pepper
        self._salt_pepper_share = salt_pepper_share
        self._photometric = photometric
        self._brightness = brightness
        self._contrast = contrast
        self._gamma = gamma
        self.sensors = sensors or Desynchronisation()

    def settings(self) -> dict[str, object]:
        """The options as plain values, for the record."""
        return {
            "reverse": self._reverse,
            "mirror": self._mirror,
            "blur": self._blur,
            "blur_sigma_px": list(self._sigmas),
            "salt_pepper": self._salt_pepper,
            "salt_pepper_share": self._salt_pepper_share,
            "photometric": self._photometric,
            "brightness": self._brightness,
            "contrast": self._contrast,
            "gamma": self._gamma,
            "sensors": self.sensors.settings(),
        }

    def mirror_only(self) -> "Augmentation":
        """The same mirroring, with sensors as far out of step, and nothing else."""
        return Augmentation(
            reverse=0.0,
            mirror=self._mirror,
            blur=0.0,
            blur_sigma_px=self._sigmas,
            salt_pepper=0.0,
            salt_pepper_share=self._salt_pepper_share,
            photometric=0.0,
            brightness=self._brightness,
            contrast=self._contrast,
            gamma=self._gamma,
            sensors=self.sensors,
        )

    def apply(self, window: TrainingWindow, rng: np.random.Generator) -> TrainingWindow:
        """A changed window; the one given is left as it is."""
        # Drawn in any case, so that switching one change off does not change the others.
        draws = rng.uniform(size=5)
        sigma = rng.uniform(*self._sigmas)
        share = rng.uniform(0.0, self._salt_pepper_share)
        tone = rng.uniform(-1.0, 1.0, size=3)
        if draws[0] < self._reverse:
            window = reversed_window(window)
        if draws[1] < self._mirror:
            window = mirrored_window(window)
        images = window.images
        if not images.size:
            return window
        if draws[2] < self._photometric:
            images = toned(
                images, 1.0 + self._brightness * tone[0], 1.0 + self._contrast * tone[1], np.exp(self._gamma * tone[2])
            )
        if draws[3] < self._blur:
            images = blurred(images, sigma)
        if draws[4] < self._salt_pepper:
            images = salted(images, share, rng)
        return window if images is window.images else replace(window, images=images)


def reversed_window(window: TrainingWindow) -> TrainingWindow:
    """The window with time running backwards; see the module."""
    stamps = window.stamps_ns
    sign = np.array([-1.0] * 3 + [1.0] * 3)
    return replace(
        window,
        images=window.images[::-1],
        stamps_ns=stamps[0] + stamps[-1] - stamps[::-1],
        T_prev_cur=se3.inverse(window.T_prev_cur[::-1]),
        imu=tuple(samples[::-1] * sign for samples in reversed(window.imu)),
        imu_time_s=tuple(times[-1] - times[::-1] if len(times) else times for times in reversed(window.imu_time_s)),
        velocity_body=-window.velocity_body[::-1],
        gravity_body=window.gravity_body[::-1],
        vo=None if window.vo is None else _reversed_answers(window.vo),
    )


def _reversed_answers(answers: PairAnswers) -> PairAnswers:
    into_earlier = se3.adjoint(answers.T_prev_cur)
    covariance = into_earlier @ answers.covariance @ np.swapaxes(into_earlier, 1, 2)
    return PairAnswers(
        T_prev_cur=se3.inverse(answers.T_prev_cur[::-1]), covariance=covariance[::-1], valid=answers.valid[::-1]
    )


def mirrored_window(window: TrainingWindow) -> TrainingWindow:
    """The window as a mirror beside the camera would show it; see the module."""
    M = np.eye(4)
    M[:3, :3] = _MIRROR
    R_body_cam = window.T_body_cam[:3, :3]
    B = R_body_cam @ _MIRROR @ R_body_cam.T
    T_body_cam = window.T_body_cam.copy()
    T_body_cam[:3, 3] = B @ T_body_cam[:3, 3]
    intrinsics = window.intrinsics_px.copy()
    intrinsics[2] = window.images.shape[2] - 1 - intrinsics[2]
    motion: Array = M @ window.T_prev_cur @ M
    return replace(
        window,
        images=window.images[:, :, ::-1],
        T_prev_cur=motion,
        imu=tuple(np.concatenate([-samples[:, :3] @ B.T, samples[:, 3:] @ B.T], axis=1) for samples in window.imu),
        intrinsics_px=intrinsics,
        T_body_cam=T_body_cam,
        velocity_body=window.velocity_body @ B.T,
        gravity_body=window.gravity_body @ B.T,
        vo=None if window.vo is None else _mirrored_answers(window.vo, M),
    )


def _mirrored_answers(answers: PairAnswers, M: Array) -> PairAnswers:
    signs = np.concatenate([-np.diag(_MIRROR), np.diag(_MIRROR)])
    return replace(
        answers, T_prev_cur=M @ answers.T_prev_cur @ M, covariance=signs[:, None] * answers.covariance * signs
    )


def toned(images: Image, brightness: float, contrast: float, gamma: float) -> Image:
    """Images uint8 with factors of brightness and of contrast (about the window's mean), and a gamma."""
    mean = float(images.mean()) / 255.0
    value = np.linspace(0.0, 1.0, 256)
    value = np.clip(((value - mean) * contrast + mean) * brightness, 0.0, 1.0) ** gamma
    table = np.round(255.0 * value).astype(np.uint8)
    changed: Image = table[images]
    return changed


def blurred(images: Image, sigma_px: float) -> Image:
    """Images (F, H, W, C) uint8 after a Gaussian blur."""
    smooth = [cv2.GaussianBlur(np.ascontiguousarray(image), (0, 0), sigma_px) for image in images]
    # OpenCV drops a channel axis of length one.
    return np.stack(smooth).reshape(images.shape)


def salted(images: Image, share: float, rng: np.random.Generator) -> Image:
    """Images (F, H, W, C) uint8 with about this share of pixels black or white, in each image others."""
    draw = rng.random(images.shape[:3], dtype=np.float32)
    changed = np.array(images)
    changed[draw < 0.5 * share] = 0
    changed[draw > 1.0 - 0.5 * share] = 255
    return changed
