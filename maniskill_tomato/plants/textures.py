"""Base colour textures made from arithmetic: leaf blades with veins, stalks, fruit skins.

All are sRGB, 8 bits, RGBA. A texture's columns follow u, its rows v, as the meshes use them: a leaf's u runs
from base to tip and v from the right margin to the left one; a fruit's u runs around and v from the calyx to
the blossom end.
"""

import numpy as np
from numpy.random import PCG64, Generator, SeedSequence
from numpy.typing import NDArray

UInt8 = NDArray[np.uint8]
Float64 = NDArray[np.float64]
Colour = tuple[float, float, float]


def _generator(kind: int, variant: int) -> Generator:
    return Generator(PCG64(SeedSequence([7411, kind, variant])))


def cloud(rng: Generator, rows: int, columns: int, cells: int, *, octaves: int = 3) -> Float64:
    """Smooth noise between -1 and 1 that repeats in both directions. Shape (rows, columns)."""
    total = np.zeros((rows, columns))
    for octave in range(octaves):
        n = cells * 2**octave
        lattice = 2 * rng.random((n, n)) - 1
        y, x = np.arange(rows) * n / rows, np.arange(columns) * n / columns
        iy, ix = y.astype(int), x.astype(int)
        fy, fx = y - iy, x - ix
        fy, fx = (fy * fy * (3 - 2 * fy))[:, None], (fx * fx * (3 - 2 * fx))[None]
        right, below = (ix + 1) % n, (iy + 1) % n
        top = lattice[np.ix_(iy, ix)] * (1 - fx) + lattice[np.ix_(iy, right)] * fx
        bottom = lattice[np.ix_(below, ix)] * (1 - fx) + lattice[np.ix_(below, right)] * fx
        total += (top * (1 - fy) + bottom * fy) * 0.55**octave
    return np.asarray(total / np.abs(total).max())


def _rgba(red: Float64, green: Float64, blue: Float64) -> UInt8:
    rgb = np.stack([red, green, blue, np.full_like(red, 255.0)], -1)
    return np.clip(np.round(rgb), 0, 255).astype(np.uint8)


def _blend(base: Float64, colour: Colour, weight: Float64) -> Float64:
    return np.asarray(base * (1 - weight[..., None]) + np.array(colour) * weight[..., None])


def _veins(t: Float64, s: Float64, lobes: float) -> Float64:
    """Strength of the midrib and the side veins, 0 to 1, at blade parameters."""
    a = np.abs(s)
    midrib = np.exp(-((a / (0.050 * (1.08 - t))) ** 2))
    # Side veins leave the midrib forward and reach the tips of the lobes.
    phase = (t - 0.20 * a + 0.05 * a * a) * 2 * lobes + 0.25 * np.sign(s)
    distance = np.abs(phase - np.round(phase))
    side = np.exp(-((distance / (0.075 * (1.1 - 0.6 * a))) ** 2)) * (1 - 0.55 * a)
    return np.maximum(midrib, 0.75 * side)


def leaf_texture(variant: int, *, upper: bool, size: int = 256) -> UInt8:
    """A leaflet's blade with its veins. Shape (size, size, 4)."""
    rng = _generator(0 if upper else 1, variant)
    t, s = np.meshgrid((np.arange(size) + 0.5) / size, 2 * (np.arange(size) + 0.5) / size - 1)
    main = _veins(t, s, 3.5)
    # The finest veins run along the zero lines of a noise, which close into cells.
    net = np.exp(-((cloud(rng, size, size, 20, octaves=2) / 0.10) ** 2))
    patches, speckle = cloud(rng, size, size, 3), cloud(rng, size, size, 24, octaves=2)
    hues: list[Colour] = [(62, 112, 44), (70, 124, 50), (54, 102, 46), (82, 132, 52)]
    base = np.ones((size, size, 3)) * np.array(hues[variant % len(hues)])
    if not upper:
        base = 0.45 * base + 0.55 * np.array([140, 178, 102])
    light: Colour = (124, 164, 82) if upper else (176, 200, 136)
    base = base * (1 + 0.13 * patches + 0.07 * speckle)[..., None]
    base = base * (1 - (0.10 if upper else 0.06) * net)[..., None]
    # The blade darkens beside the veins, where it dips, and is fresher between them.
    base = _blend(base, light, 0.62 * main)
    edge = np.clip((np.abs(s) - 0.90) / 0.10, 0, 1) * np.clip(0.5 + cloud(rng, size, size, 5), 0, 1)
    base = _blend(base, (128, 134, 62), 0.30 * edge)
    return _rgba(base[..., 0], base[..., 1], base[..., 2])


def wilted_texture(variant: int, *, upper: bool, size: int = 256) -> UInt8:
    """A dying leaf: the fresh one's veins on yellow, brown from the margin inward."""
    fresh = leaf_texture(variant, upper=upper, size=size)[..., :3].astype(np.float64)
    rng = _generator(7 if upper else 8, variant)
    across = np.abs(2 * (np.arange(size) + 0.5) / size - 1)[:, None]
    patches = cloud(rng, size, size, 4)
    shade = fresh.mean(-1, keepdims=True) / fresh.mean()
    base = shade * np.array([178, 168, 78])
    base = _blend(base, (126, 92, 52), np.clip(1.1 * across + 0.6 * patches - 0.35, 0, 1))
    return _rgba(base[..., 0], base[..., 1], base[..., 2])


def stalk_texture(kind: int, colour: Colour, *, streak: float, size: int = 128) -> UInt8:
    """A stem, petiole or peduncle: lengthwise streaks, pale fine hairs, a darker tint here and there."""
    rng = _generator(2, kind)
    length = cloud(rng, size, size, 4)
    lines = cloud(rng, 1, size, 16, octaves=2)[0][None, :]
    hairs = rng.random((size, size))
    base = np.ones((size, size, 3)) * np.array(colour)
    base = base * (1 + streak * lines + 0.10 * length)[..., None]
    base = _blend(base, (205, 214, 176), 0.30 * (hairs > 0.93).astype(np.float64))
    base = _blend(base, (92, 84, 58), 0.16 * np.clip(length, 0, 1))
    return _rgba(base[..., 0], base[..., 1], base[..., 2])


def calyx_texture(size: int = 64) -> UInt8:
    """Sepals: dark green with a paler midrib and tip."""
    rng = _generator(3, 0)
    u, v = np.meshgrid((np.arange(size) + 0.5) / size, 2 * (np.arange(size) + 0.5) / size - 1)
    base = (
        np.ones((size, size, 3)) * np.array([74, 118, 48]) * (1 + 0.10 * cloud(rng, size, size, 4))[..., None]
    )
    base = _blend(base, (128, 164, 84), 0.5 * np.exp(-((v / 0.22) ** 2)))
    base = _blend(base, (120, 132, 66), 0.5 * u**2)
    return _rgba(base[..., 0], base[..., 1], base[..., 2])


def skin_texture(ripeness: str, variant: int, *, rows: int = 128, columns: int = 256) -> UInt8:
    """A fruit's skin: shaded at the calyx, colouring from the blossom end upward while it turns."""
    kind = {"ripe": 4, "turning": 5, "green": 6}[ripeness]
    rng = _generator(kind, variant)
    v = ((np.arange(rows) + 0.5) / rows)[:, None] * np.ones((1, columns))
    soft, fine = cloud(rng, rows, columns, 3), cloud(rng, rows, columns, 40, octaves=1)
    if ripeness == "ripe":
        reds: list[Colour] = [(188, 26, 16), (200, 36, 18), (176, 20, 18)]
        base = np.ones((rows, columns, 3)) * np.array(reds[variant % 3]) * (1 + 0.05 * soft)[..., None]
        base = _blend(base, (206, 74, 24), 0.40 * np.exp(-((v / 0.16) ** 2)))
    elif ripeness == "turning":
        amount = [0.20, 0.45, 0.70, 0.95][variant % 4]
        front = np.clip((v + 0.30 * soft - (0.75 - 0.75 * amount)) / 0.45, 0, 1)
        base = _blend(np.ones((rows, columns, 3)) * np.array([158, 160, 62]), (218, 120, 30), front)
        base = _blend(base, (206, 62, 24), np.clip(front * (0.35 + amount) - 0.45, 0, 1))
    else:
        greens: list[Colour] = [(126, 152, 66), (112, 142, 58), (142, 162, 82)]
        base = np.ones((rows, columns, 3)) * np.array(greens[variant % 3]) * (1 + 0.05 * soft)[..., None]
        # Unripe fruits keep a darker green shoulder.
        base = _blend(base, (66, 104, 36), 0.75 * np.clip(1.15 - 2.6 * v + 0.2 * soft, 0, 1))
    base = base * (1 + 0.018 * fine)[..., None]
    scar = np.exp(-(((1 - v) / 0.022) ** 2)) + np.exp(-((v / 0.05) ** 2)) * 0.5
    base = _blend(base, (112, 84, 46), 0.7 * np.clip(scar, 0, 1))
    return _rgba(base[..., 0], base[..., 1], base[..., 2])
