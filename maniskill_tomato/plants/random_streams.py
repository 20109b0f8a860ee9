"""Random numbers of a plant: a stream of its own for each organ, so that leaving one out changes no other."""

from enum import IntEnum

from numpy.random import PCG64, Generator, SeedSequence


class Stream(IntEnum):
    """What a stream of random numbers decides; the values are part of a plant's identity."""

    STEM = 0
    LEAF = 1
    TRUSS = 2
    FRUIT = 3
    VIEW = 4
    SIDE_LEAF = 5
    CURTAIN = 6
    NEIGHBOUR = 7
    DENSITY = 8
    KIND = 9
    CLUTTER = 10
    SHOOT = 11
    WILTED = 12
    FLOWER = 13


def stream(seed: int, kind: Stream, index: int = 0) -> Generator:
    """The random numbers of the `index`-th organ of a kind in the plant `seed`."""
    return Generator(PCG64(SeedSequence([seed, int(kind), index])))


def normal(rng: Generator, mean: float, spread: float, limit: float = 2.5) -> float:
    """A normal draw, clipped to `limit` standard deviations."""
    return mean + spread * min(max(float(rng.standard_normal()), -limit), limit)


def uniform(rng: Generator, bounds: tuple[float, float]) -> float:
    """A uniform draw between (low, high)."""
    return bounds[0] + (bounds[1] - bounds[0]) * float(rng.random())
