"""Plants and what is made of them, kept for environments that show them again, within a number of bytes."""

import contextlib
import ctypes
import os
import sys
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import cache
from typing import Any, Final, TypeVar

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Plant

LIMIT_VARIABLE: Final = "TOMATO_PLANT_STORE_MB"
"""Environment variable with the most that one process keeps, in megabytes."""

DEFAULT_LIMIT_MB: Final = 1536
"""The general tasks' pool of 100 plants with their neighbours in the row takes 1.2 GiB with its meshes for rays."""

BYTES_OF_A_VERTEX: Final = 64
"""Position, normal and texture coordinates, and the positions of its organ and its plant once more."""

BYTES_OF_A_FACE: Final = 40
"""Vertex indices of its part, organ and plant."""

GIVE_BACK_EVERY: Final = 64_000_000
"""After so many bytes that were let go, the allocator's holes between what is kept go back to the system."""

T = TypeVar("T")


class ByteStore:
    """Keeps things by their keys; what was asked for longest ago goes first.

    What is not kept any more is found again for as long as somebody else holds on to it.
    """

    def __init__(self, limit: Callable[[], int]) -> None:
        """Begins empty.

        Args:
            limit: Asked for the most bytes whenever something new is kept.
        """
        self._limit = limit
        self._kept: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._elsewhere: weakref.WeakValueDictionary[Hashable, Any] = weakref.WeakValueDictionary()
        self._lock = threading.Lock()
        self._gone = 0
        self.size = 0
        """Of everything that is kept, in [bytes]."""

    def get(self, key: Hashable, make: Callable[[], T], size_of: Callable[[T], int]) -> T:
        """What is kept under a key, or else made now.

        Args:
            key: Tells things apart; it is kept alive as long as the thing.
            make: Makes it.
            size_of: Its bytes. What is larger than the limit is handed out, but not kept.
        """
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                thing: T = self._kept[key][0]
                return thing
            held = self._elsewhere.get(key)
        thing = make() if held is None else held
        size, limit = size_of(thing), self._limit()
        with self._lock:
            with contextlib.suppress(TypeError):  # Such as numbers, which nobody else can hold.
                self._elsewhere[key] = thing
            if key not in self._kept and size <= limit:
                self._kept[key] = (thing, size)
                self.size += size
            while self.size > limit:
                _, (_, gone) = self._kept.popitem(last=False)
                self.size -= gone
                self._gone += gone
            give_back = self._gone > GIVE_BACK_EVERY
            self._gone = 0 if give_back else self._gone
        if give_back:
            _trim()
        return thing

    def find(self, key: Hashable) -> Any:
        """What `get` would find under a key without making it; else None."""
        with self._lock:
            return self._kept[key][0] if key in self._kept else self._elsewhere.get(key)

    def __len__(self) -> int:
        return len(self._kept)


def _trim() -> None:
    """Asks glibc to return free pages, which it does not do by itself; other allocators are left alone."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


@cache
def store_limit() -> int:
    """The most that is kept, in [bytes].

    Raises:
        InvalidInputError: The environment variable is no number of megabytes.
    """
    text = os.environ.get(LIMIT_VARIABLE, str(DEFAULT_LIMIT_MB))
    if not text.isascii() or not text.isdigit() or len(text) > 9:
        raise InvalidInputError(
            f"{LIMIT_VARIABLE} must be a whole number of megabytes, 0 or more (0 keeps nothing), got {text!r}"
        )
    return int(text) * 1_000_000


def plant_bytes(plant: Plant) -> int:
    """What a plant takes in memory, in [bytes]."""
    parts = [part for organ in plant.organs for part in organ.parts]
    vertices, faces = (sum(len(getattr(part, name)) for part in parts) for name in ("vertices", "faces"))
    textures = {id(part.texture): part.texture.nbytes for part in parts if part.texture is not None}
    return BYTES_OF_A_VERTEX * vertices + BYTES_OF_A_FACE * faces + sum(textures.values())


PLANT_STORE: Final = ByteStore(store_limit)
"""Of this process."""
