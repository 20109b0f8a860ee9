"""Warp kernels over batches: a row is what it is alone, whatever the batch's size and the calls before."""

import pytest
import torch

from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.warp_runtime import LARGEST_KEPT_BATCH, room_for


@pytest.mark.parametrize(
    ("rows", "room"), [(1, 1), (2, 2), (3, 4), (4, 4), (5, 8), (4096, 4096), (4097, 8192)]
)
def test_room_is_the_next_power_of_two(rows: int, room: int) -> None:
    assert room_for(rows) == room


def test_batches_of_changing_sizes_have_their_own_rows() -> None:
    qpos = torch.rand(LARGEST_KEPT_BATCH + 9, 7, generator=torch.Generator().manual_seed(0))
    alone = torch.cat([link_transforms(q[None]) for q in qpos[:8]])
    for size in (7, 8, 3, len(qpos), 5, 1):
        together = link_transforms(qpos[:size])
        assert together.shape == (size, *alone.shape[1:])
        torch.testing.assert_close(together[:8], alone[:size], atol=0.0, rtol=0.0)
