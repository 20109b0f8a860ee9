"""A stretch of greenhouse row: all ripe tomatoes in reach must be seen, one after the other."""

from typing import Any

import numpy as np
import torch
from mani_skill.utils.registration import register
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.tasks import MAX_ROW_STEPS
from maniskill_tomato.tasks.general import TomatoViewpointGeneralEnv

REACHABLE_SHARE = 0.1
"""A fruit is in reach when the arm can look at it from this share of the lattice's candidates or more."""

MAX_TARGETS = 64
"""Ripe fruits of a row that are kept track of."""


class TomatoViewpointRowEnv(TomatoViewpointGeneralEnv):
    """**Task Description:**
    Three plants of a row carry ripe tomatoes. Look at one after the other until each was fully visible: when a target
    has been seen, or 20 moves were made for it, the nearest one left is the next, and the memory begins anew.

    **Randomizations:**
    - As in `TomatoViewpoint-v1`; the first target is a ripe fruit in reach that is hidden from the first view.

    **Success Conditions:**
    - Every ripe fruit in reach was fully visible (V_f above 0.8) while it was the target.

    The episode fails when no target is left and some were not seen. Info has beside that of `TomatoViewpoint-v1`:
    `seen_count`, `target_count`, and `target_done` (the target of this move was seen). `visible_fraction` and
    `visible_fraction_gain` are those of the target that the move was made for, also when another one has just become
    the target. Episode lists do not apply.
    """

    def __init__(self, *args: Any, episodes: None = None, **kwargs: Any) -> None:
        if episodes is not None:
            raise InvalidInputError("TomatoViewpointRow-v1 has no episode lists; choose plants with plant=")
        super().__init__(*args, **kwargs)

    def _make_tools(self) -> None:
        super()._make_tools()
        n, device = self.num_envs, self.device
        self._open = torch.zeros(n, MAX_TARGETS, dtype=torch.bool, device=device)
        self._seen_count = torch.zeros(n, dtype=torch.int64, device=device)
        self._target_count = torch.zeros(n, dtype=torch.int64, device=device)
        self._target_moves = torch.zeros(n, dtype=torch.int64, device=device)
        self._target_done = torch.zeros(n, dtype=torch.bool, device=device)

    def _candidates(self, env_index: int) -> list[int]:
        ripe = [j for j in self.planting.ripe_fruits[env_index] if j < MAX_TARGETS]
        positions = self._fruit_positions(env_index, ripe)
        share = self._observer.lattice.reachable(positions).float().mean(dim=-1)
        return [j for j, s in zip(ripe, share.tolist(), strict=True) if s >= REACHABLE_SHARE]

    def _begin(self, env_idx: Tensor) -> None:
        self._open[env_idx] = False
        for i in (int(i) for i in env_idx):
            in_reach = self._candidates(i)
            self._open[i, in_reach] = True
            self._open[i, int(self._target[i])] = True
        self._target_count[env_idx] = self._open[env_idx].sum(-1)
        self._seen_count[env_idx] = 0
        self._target_moves[env_idx] = 0
        self._target_done[env_idx] = False
        super()._begin(env_idx)

    def _moves_left(self) -> Tensor:
        left = torch.minimum(self.task.max_moves - self._target_moves, MAX_ROW_STEPS - self._moves)
        return left.clamp_min(0)

    def _step_action(self, action: Any) -> Tensor | None:
        if action is not None:
            self._target_moves = self._target_moves + 1
        batch = super()._step_action(action)
        if batch is None:
            return None
        self._target_done = self._visible_fraction > self.task.full_visibility
        given_up = self._target_moves >= self.task.max_moves
        self._seen_count = self._seen_count + self._target_done.long()
        for i in (self._target_done | given_up).nonzero()[:, 0].tolist():
            self._next_target(i)
        return batch

    def _next_target(self, env_index: int) -> None:
        """Turns to the nearest fruit left, if there is one."""
        self._open[env_index, self._target[env_index]] = False
        left = self._open[env_index].nonzero()[:, 0].tolist()
        if not left:
            return
        away = self._fruit_positions(env_index, left) - self._camera_position[env_index]
        self._target = self._target.clone()
        self._target[env_index] = left[int(np.argmin(away.norm(dim=-1).tolist()))]
        self._target_moves[env_index] = 0
        self._look_up_target()
        fraction = self._visible_fraction
        self._look_anew(torch.tensor([env_index], device=self.device))
        # What the move itself brought is judged by the target that it was made for.
        self._visible_fraction = fraction

    def evaluate(self) -> dict[str, Tensor]:
        """What came of the last move, and how much of the row is done."""
        info = super().evaluate()
        success = self._seen_count >= self._target_count
        info["success"] = success
        info["fail"] = ~self._open.any(-1) & ~success
        info["seen_count"] = self._seen_count.clone()
        info["target_count"] = self._target_count.clone()
        info["target_done"] = self._target_done.clone()
        return info

    def compute_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """`view_gain_reward` of the last move, each target that was seen being a success. Shape (num_envs,)."""
        return super().compute_dense_reward(obs, action, {**info, "success": info["target_done"]})

    def _task_state(self) -> dict[str, Tensor]:
        row = [self._seen_count, self._target_count, self._target_moves, self._target_done]
        return {
            **super()._task_state(),
            "row": torch.stack([x.float() for x in row], dim=-1),
            "row_fraction": self._visible_fraction[:, None].clone(),
            "open": self._open.float(),
        }

    def _set_task_state(self, indices: Tensor, task: dict[str, Tensor]) -> None:
        self._open, self._target_done = self._open.clone(), self._target_done.clone()
        self._seen_count, self._target_count = self._seen_count.clone(), self._target_count.clone()
        self._target_moves = self._target_moves.clone()
        counts = task["row"].long()
        self._seen_count[indices], self._target_count[indices] = counts[:, 0], counts[:, 1]
        self._target_moves[indices], self._target_done[indices] = counts[:, 2], counts[:, 3].bool()
        self._open[indices] = task["open"].bool()
        fraction = self._visible_fraction.clone()
        super()._set_task_state(indices, task)
        fraction[indices] = task["row_fraction"][:, 0]
        self._visible_fraction = fraction


# Gymnasium's registry has the id already, lazily; this line tells ManiSkill's own.
register("TomatoViewpointRow-v1", TomatoViewpointRowEnv, max_episode_steps=MAX_ROW_STEPS)
