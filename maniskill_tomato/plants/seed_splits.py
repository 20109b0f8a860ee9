"""Which plants are for training, for choosing and for reporting: disjoint ranges of seeds."""

SEED_SPLITS: dict[str, tuple[int, int]] = {
    "train": (0, 1_000_000),
    "validation": (1_000_000, 2_000_000),
    "held_out": (2_000_000, 3_000_000),
}
"""Half-open, disjoint ranges of plant seeds; a choice with a split's name as seed takes a new plant at every
reset."""
