"""The names of the planners; cheap to import, so that a command line is checked before PyTorch loads."""

from typing import Literal, get_args

PlannerName = Literal[
    "stay",
    "random_step",
    "random_viewpoint",
    "fixed_sweep",
    "look_at",
    "3dmts_memory",
    "deep_3dmts",
    "gradient_nbv",
    "nbv_direction",
    "nbv",
    "view_quality",
    "3dmts",
    "greedy_truth",
    "lattice_oracle",
    "oracle",
]

PLANNERS: tuple[str, ...] = get_args(PlannerName)
"""All names."""

PRIVILEGED: tuple[str, ...] = ("3dmts", "greedy_truth", "lattice_oracle", "oracle")
"""Those that know the truth."""
