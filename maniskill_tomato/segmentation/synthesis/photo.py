"""Turns rendered light into a photo: exposure, white balance, lens, motion, noise and tone of a small camera."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class PhotoSettings:
    """How one photo is taken."""

    exposure: float
    """Factor on the exposure that makes the picture's middle grey."""
    white_balance: tuple[float, float, float]
    """Factors on red, green and blue."""
    defocus: float
    """Radius of the blur disc of things far from the plane in focus, in [px] of a picture 640 wide."""
    focus_m: float
    """Distance in focus, in [m]."""
    motion: tuple[float, float]
    """Movement during the exposure, in [px]."""
    vignette: float
    """Loss of light in the corners, 0 to 1."""
    noise: float
    """Standard deviation of the noise of a white pixel, in units of white; darker ones have its square root's share."""
    saturation: float
    """Factor on the distance to grey."""
    contrast: float
    """Strength of the S-shaped tone curve, 0 to 1."""
    ambient_occlusion: float
    """Darkening of what lies close behind other things, 0 to 1."""
    haze: float
    """Share of stray light."""
    sharpening: float
    """Weight of the unsharp mask that such cameras apply."""


def draw_photo_settings(rng: Generator) -> PhotoSettings:
    """Draws the settings and faults of one photo."""
    warmth, tint = np.clip(rng.normal(0, 0.07), -0.14, 0.14), np.clip(rng.normal(0, 0.03), -0.05, 0.05)
    moving = rng.random() < 0.2
    return PhotoSettings(
        exposure=float(np.exp(rng.normal(-0.08, 0.4))),
        white_balance=(float(np.exp(warmth)), float(np.exp(tint)), float(np.exp(-warmth))),
        defocus=float(rng.uniform(0.0, 4.5)),
        focus_m=float(np.exp(rng.uniform(np.log(0.3), np.log(1.2)))),
        motion=(float(rng.normal(0, 3.0)), float(rng.normal(0, 3.0))) if moving else (0.0, 0.0),
        vignette=float(rng.uniform(0, 0.35)),
        noise=float(np.exp(rng.uniform(np.log(0.004), np.log(0.03)))),
        saturation=float(np.clip(rng.normal(0.98, 0.14), 0.6, 1.35)),
        contrast=float(rng.uniform(0.2, 0.9)),
        ambient_occlusion=float(rng.uniform(0.4, 1.0)),
        haze=float(rng.uniform(0, 0.05)),
        sharpening=float(rng.uniform(0, 0.7)),
    )


def develop(
    light: Float32, depth_m: NDArray[np.float64], settings: PhotoSettings, rng: Generator
) -> NDArray[np.uint8]:
    """Takes the photo.

    Args:
        light: Linear RGB. Shape (height, width, 3).
        depth_m: In [m]; infinite where nothing is. Shape (height, width).
        settings: Settings and faults.
        rng: The noise.

    Returns:
        sRGB. Shape (height, width, 3).
    """
    height, width = depth_m.shape
    scale = width / 640
    picture = light * _occlusion(depth_m, scale, settings.ambient_occlusion)[..., None]
    picture = _defocused(picture, depth_m, settings, scale)
    if settings.motion != (0.0, 0.0):
        picture = _moved(picture, (settings.motion[0] * scale, settings.motion[1] * scale))
    # The exposure metering weights the middle and saturates.
    y, x = np.mgrid[:height, :width].astype(np.float32)
    aside = ((x / width - 0.5) ** 2 + (y / height - 0.5) ** 2).astype(np.float32)
    weight = np.exp(-aside / 0.15)
    metered = float((np.minimum(picture.mean(2), 1.0) * weight).sum() / weight.sum())
    picture = picture * np.float32(0.19 / max(metered, 0.02) * settings.exposure)
    picture = picture * np.array(settings.white_balance, dtype=np.float32)
    picture = picture * (1 - settings.vignette * 2 * aside)[..., None]
    small = cv2.resize(np.minimum(picture, 3.0), None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
    glow = cv2.resize(cv2.GaussianBlur(small, (0, 0), 2.5 * scale), (width, height))
    picture = (1 - settings.haze) * picture + settings.haze * glow
    shot = np.sqrt(np.clip(picture, 0, 1)) * settings.noise + 0.25 * settings.noise
    grain = rng.standard_normal(picture.shape, dtype=np.float32)
    if settings.noise > 0.012:
        grain = 1.6 * cv2.GaussianBlur(grain, (0, 0), 0.8)
    picture = np.maximum(picture + shot * grain, 0)
    return _toned(picture, settings)


def _toned(picture: Float32, settings: PhotoSettings) -> NDArray[np.uint8]:
    # A shoulder keeps some drawing in the lights, as cameras do, before they clip.
    picture = np.where(picture > 0.7, 0.7 + 0.3 * (1 - np.exp(-(picture - 0.7) / 0.3)), picture)
    display = np.sqrt(picture)  # Close to the sRGB curve, and quick.
    smooth = display * display * (3 - 2 * display)
    display = (1 - settings.contrast) * display + settings.contrast * smooth
    grey = display @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    display = grey[..., None] + settings.saturation * (display - grey[..., None])
    if settings.sharpening > 0:
        soft = cv2.GaussianBlur(display.astype(np.float32), (0, 0), 1.2)
        display = display + settings.sharpening * (display - soft)
    return np.asarray(np.clip(display * 255 + 0.5, 0, 255), dtype=np.uint8)


def _occlusion(depth_m: NDArray[np.float64], scale: float, strength: float) -> Float32:
    """Darkening where the surroundings are nearer, after Luft et al. 2006 (unsharp masking of the depth buffer)."""
    depth = np.minimum(depth_m, 4.0).astype(np.float32)
    darkening = np.zeros_like(depth)
    for part, sigma, reach, share in ((2, 8.0, 0.03, 0.3), (4, 28.0, 0.08, 0.4), (8, 80.0, 0.16, 0.45)):
        small = cv2.resize(depth, None, fx=1 / part, fy=1 / part, interpolation=cv2.INTER_AREA)
        nearer = small - cv2.GaussianBlur(small, (0, 0), sigma / part * scale)
        # What lies far behind an edge is lit by its own surroundings again.
        dark = share * np.clip(nearer / reach, 0, 1) * np.exp(-np.clip(nearer, 0, None) / (5 * reach))
        darkening += cv2.resize(
            np.asarray(dark, np.float32), (depth.shape[1], depth.shape[0]), interpolation=cv2.INTER_LINEAR
        )
    darkening *= np.exp(-np.clip(depth - 0.6, 0, None) / 0.6)
    return np.asarray(np.exp(-1.5 * strength * darkening), dtype=np.float32)


def _defocused(
    picture: Float32, depth_m: NDArray[np.float64], settings: PhotoSettings, scale: float
) -> Float32:
    """Mixes blurred copies of the picture by each pixel's distance from the plane in focus."""
    if settings.defocus * scale < 0.5:
        return picture
    depth = np.minimum(depth_m, 6.0).astype(np.float32)
    radius = (
        settings.defocus
        * scale
        * np.minimum(np.abs(1 / depth - 1 / settings.focus_m) / (1 / 0.3 - 1 / 0.8), 1.5)
    )
    radius = cv2.GaussianBlur(radius.astype(np.float32), (0, 0), 1.5)
    levels = [0.0, 1.0, 2.0, 4.0, 7.0]
    result = picture
    for low, high in zip(levels[:-1], levels[1:], strict=True):
        if radius.max() <= low:
            break
        blurred = cv2.GaussianBlur(picture, (0, 0), high * 0.7)
        weight = np.clip((radius - low) / (high - low), 0, 1)[..., None]
        result = result * (1 - weight) + blurred * weight
    return np.asarray(result, dtype=np.float32)


def _moved(picture: Float32, motion: tuple[float, float]) -> Float32:
    size = 2 * int(np.ceil(max(abs(motion[0]), abs(motion[1])) / 2)) + 3
    kernel = np.zeros((size, size), np.float32)
    for t in np.linspace(-0.5, 0.5, 4 * size):
        x, y = size / 2 + t * motion[0], size / 2 + t * motion[1]
        kernel[int(np.clip(y, 0, size - 1)), int(np.clip(x, 0, size - 1))] += 1
    moved = cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)
    return np.asarray(moved, np.float32)
