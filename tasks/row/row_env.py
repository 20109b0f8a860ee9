"""A stretch of greenhouse row: all ripe tomatoes in reach must be seen, one after the other."""

from typing import Any, Final, Literal, get_args

import numpy as np
import torch
from mani_skill.utils.registration import register
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import moved_position
from maniskill_tomato.robot.transit import TRANSIT_MOVES, Transit, TransitPlanner
from maniskill_tomato.tasks import MAX_ROW_STEPS, options
from maniskill_tomato.tasks.maniskill.motion import drive_to
from maniskill_tomato.tasks.row.env import TomatoViewpointGeneralEnv

REACHABLE_SHARE = 0.1
"""A fruit is in reach when the arm can look at it from this share of the lattice's candidates or more."""

MAX_TARGETS = 64
"""Ripe fruits of a row that are kept track of."""


Transits = Literal["none", "target", "refused", "both"]
"""When the arm goes by its ready posture (`robot.transit`): never; to the next target, if it cannot look at it from
where it stands; where a move is refused, if another posture reaches the place; or both."""

STAND_OFF: Final = 0.3
"""Places for the first view of a target are at least this far from it, in [m]."""


class TomatoViewpointRowEnv(TomatoViewpointGeneralEnv):
    """**Task Description:**
    Three plants of a row carry ripe tomatoes. Look at one after the other until each was fully visible: when a target
    has been seen, or 20 moves were made for it, the nearest one left is the next, and the memory begins anew.

    **Randomizations:**
    - As in `TomatoViewpoint-v1`; the first target is a ripe fruit in reach that is hidden from the first view.

    **Success Conditions:**
    - Every ripe fruit in reach was fully visible (V_f above 0.8) while it was the target.

    An arm that is bent the wrong way for the next target takes it up anew, by its ready posture (`robot.transit`): when
    the target changes and it cannot look at the new one from where the camera is, it goes to the nearest place
    `STAND_OFF` or more from it; when a move is refused though another posture reaches the place, it goes there. Such
    a transit counts as `TRANSIT_MOVES` moves with its whole path, clearance and cost.

    The episode fails when no target or no move of the 120 is left and some were not seen. Info has beside that of
    `TomatoViewpoint-v1`: `seen_count`, `target_count`, `target_done` (the target of this move was seen), `transits` (of
    this move) and `joint_path_length` [rad]. `visible_fraction` and `visible_fraction_gain` are those of the target
    that the move was made for, also when another one has just become the target. Episode lists do not apply.

    **Options:** `transits`: `"none"`, `"target"` (the first rule alone), `"refused"` (the second) or `"both"`.
    """

    def __init__(self, *args: Any, episodes: None = None, transits: Transits = "both", **kwargs: Any) -> None:
        if episodes is not None:
            raise InvalidInputError("TomatoViewpointRow-v1 has no episode lists; choose plants with plant=")
        options.check_choice("transits", transits, get_args(Transits))
        self.transits: Transits = transits
        super().__init__(*args, **kwargs)

    def _make_tools(self) -> None:
        super()._make_tools()
        n, device = self.num_envs, self.device
        self._transit_planner = TransitPlanner(device)
        self._transit = torch.zeros(n, dtype=torch.int64, device=device)
        self._joint_path = torch.zeros(n, device=device)
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
        self._transit[env_idx] = 0
        self._joint_path[env_idx] = 0.0
        super()._begin(env_idx)

    def _moves_left(self) -> Tensor:
        left = torch.minimum(self.task.max_moves - self._target_moves, MAX_ROW_STEPS - self._moves)
        return left.clamp_min(0)

    def _step_action(self, action: Any) -> Tensor | None:
        if action is not None:
            self._target_moves = self._target_moves + 1
            self._transit = torch.zeros_like(self._transit)
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
        env_idx = torch.tensor([env_index], device=self.device)
        self._forget(env_idx)
        if self.transits in ("target", "both"):
            self._turn_to_target(env_index)
        self._look_first(env_idx)
        # What the move itself brought is judged by the target that it was made for.
        self._visible_fraction = fraction

    def open_targets(self, env_index: int = 0) -> list[int]:
        """The fruits that are yet to be looked for, the target among them, as indices in `Plant.fruits`."""
        return [int(j) for j in self._open[env_index].nonzero()[:, 0]]

    def fruit_position_w(self, env_index: int, fruit: int) -> Tensor:
        """Centre of a fruit in the world frame, in [m]. Shape (3,)."""
        return self._fruit_positions(env_index, [fruit])[0]

    # ---------------------------------------------------------------- transits

    def _turn_to_target(self, env_index: int) -> None:
        """A transit to the nearest place for a first view, if the camera cannot look at the target from where it is."""
        target = self._known_target_position()[env_index]
        qpos = self.agent.robot.get_qpos()[env_index]
        if self._transit_planner.can_turn(qpos, target):
            return
        places = self._candidates_near(target, self._camera_position[env_index])
        away = (places - target).norm(dim=-1)
        way = self._transit_planner.plan(qpos, places[away >= STAND_OFF], target)
        if way is not None:
            self._path_length = self._path_length.clone()
            self._path_length[env_index] += self._go_by(env_index, way)

    def _pass_way(self, before: Tensor, position: Tensor, action: Tensor) -> Tensor:
        length = super()._pass_way(before, position, action)
        qpos = self.agent.robot.get_qpos()
        self._joint_path = self._joint_path + (qpos - before).abs().sum(-1)
        looks = self.agent.control_mode == "pd_look_at"
        if not looks or self.transits not in ("refused", "both"):
            return length
        target = self._known_target_position()
        for i in (self._reach == int(Reach.UNREACHABLE)).nonzero()[:, 0].tolist():
            place = moved_position(position[i], target[i], action[i])
            way = self._transit_planner.plan(qpos[i], place[None], target[i])
            if way is not None:
                length[i] = self._go_by(i, way)
                self._reach[i] = int(Reach.REACHABLE)
        return length

    def _candidates_near(self, target: Tensor, position: Tensor) -> Tensor:
        """The lattice's candidates round a target, those near to a position first. Shape (K, 3)."""
        candidates = self._observer.lattice.positions(target[None])[0]
        near_first: Tensor = candidates[(candidates - position).norm(dim=-1).argsort()]
        return near_first

    def _go_by(self, env_index: int, way: Transit) -> float:
        """Moves an arm along a transit and counts it; returns the length of the camera's way, in [m]."""
        waypoints = way.waypoints.float()
        for k in range(1, len(waypoints)):
            goal = self.agent.robot.get_qpos().clone()
            goal[env_index] = waypoints[k]
            if self.motion == "dynamic":
                drive_to(self.scene, self.agent, goal)
            elif k == len(waypoints) - 1:
                self._put_joints(goal)
        self._observe_viewpoint()
        passed = way.passed.float()
        legs = len(passed) - 1
        T_w_plant = self.planting.T_world_plant[env_index].expand(legs, 4, 4)
        env_idx = torch.full((legs,), env_index, device=self.device)
        clearance = self._ray_scene.clearance_along(passed[:-1], passed[1:], T_w_plant, env_idx).min()
        row = torch.arange(self.num_envs, device=self.device) == env_index
        self._clearance = torch.where(row, self._clearance.minimum(clearance), self._clearance)
        self._joint_path = self._joint_path + row * way.joint_path_rad
        self._moves = self._moves + row * TRANSIT_MOVES
        self._target_moves = self._target_moves + row * TRANSIT_MOVES
        self._transit = self._transit + row.long()
        return way.camera_path_m

    def evaluate(self) -> dict[str, Tensor]:
        """What came of the last move, and how much of the row is done."""
        info = super().evaluate()
        success = self._seen_count >= self._target_count
        info["success"] = success
        over = ~self._open.any(-1) | (self._moves >= MAX_ROW_STEPS)
        info["fail"] = over & ~success
        info["seen_count"] = self._seen_count.clone()
        info["target_count"] = self._target_count.clone()
        info["target_done"] = self._target_done.clone()
        info["transits"] = self._transit.clone()
        info["joint_path_length"] = self._joint_path.clone()
        return info

    def compute_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """`view_gain_reward`, each target that was seen being a success, less the cost of a transit's moves.
        Shape (num_envs,)."""
        reward = super().compute_dense_reward(obs, action, {**info, "success": info["target_done"]})
        return reward - self.task.step_cost * TRANSIT_MOVES * info["transits"]

    def _task_state(self) -> dict[str, Tensor]:
        row = [
            self._seen_count,
            self._target_count,
            self._target_moves,
            self._target_done,
            self._transit,
            self._joint_path,
        ]
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
        self._transit, self._joint_path = self._transit.clone(), self._joint_path.clone()
        self._transit[indices], self._joint_path[indices] = counts[:, 4], task["row"][:, 5].float()
        self._open[indices] = task["open"].bool()
        fraction = self._visible_fraction.clone()
        super()._set_task_state(indices, task)
        fraction[indices] = task["row_fraction"][:, 0]
        self._visible_fraction = fraction


# Gymnasium's registry has the id already, lazily; this line tells ManiSkill's own.
register("TomatoViewpointRow-v1", TomatoViewpointRowEnv, max_episode_steps=MAX_ROW_STEPS)
