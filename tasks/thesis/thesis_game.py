"""The rules of the thesis's tasks: nine observed numbers, increments of the viewpoint, a reward for every view."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.perception_kinds import Perception
from maniskill_tomato.tasks.arm_moves import Plan
from maniskill_tomato.tasks.own_rules import Moved
from maniskill_tomato.tasks.senses import (
    CameraConfig,
    CameraSenses,
    ViewMeasurement,
    ViewPoses,
    camera_info,
    check_pictures,
    new_view,
    remembered_views,
)
from maniskill_tomato.tasks.thesis.starts import Starts
from maniskill_tomato.tasks.thesis.thesis_config import ViewpointTaskConfig
from maniskill_tomato.tasks.thesis.thesis_rewards import in_forbidden_zone
from maniskill_tomato.tasks.world import World


class ThesisGame:
    """One class for both tasks; a `ViewpointTaskConfig` tells them apart."""

    keeps_belief = False

    def __init__(
        self,
        world: World,
        task: ViewpointTaskConfig,
        other_targets: int = 0,
        perception: Perception = "ground_truth",
        camera: CameraConfig | None = None,
    ) -> None:
        """Plays in a world.

        Args:
            world: The plants and arms.
            task: Starts, thresholds and rewards.
            other_targets: How many other ripe fruits are judged at every step as if each were the target.
            perception: Where V_f, what is seen and the target's position come from. With a camera the target is the
                largest ripe fruit of the first picture that shows one (Algorithm 2).
            camera: How a camera tells fruits apart; None without one.
        """
        self.saved_columns: tuple[str, ...] = ("viewpoint", "reach", "target", "plant_pose", "plant_seed")
        self._camera: CameraSenses | None = None
        if perception != "ground_truth":
            assert camera is not None
            check_pictures(perception, world)
            self._camera = CameraSenses(world, perception, camera, 1.0, keeps_target=True)
            self.saved_columns += (
                "views",
                "view_count",
                "looks",
                "noise_seed",
                "hidden_below",
                "targets_begun",
            )
        self._measured: ViewMeasurement | None = None
        self.task = task
        self._world = world
        self._other_targets = other_targets
        self._starts = Starts(task, world.device)
        self._view: dict[str, Tensor] = {}
        self._views_of_others: list[dict[str, Tensor]] = []
        self._others_before: list[Tensor] = []

    @property
    def perception(self) -> CameraPerception:
        """What a camera has measured.

        Raises:
            AttributeError: There is none.
        """
        if self._camera is None:
            raise AttributeError("perception")
        return self._camera.perception

    def draw_plant(self, env_index: int, rng: np.random.RandomState, options: Mapping[str, Any]) -> int:
        """The seed of an environment's next plant, the first draw of its episode."""
        return self._world.plant_batch.spec.draw_seed(rng)

    def begin(
        self, env_idx: Tensor, rngs: Sequence[np.random.RandomState], options: Mapping[str, Any]
    ) -> None:
        """Draws targets among the ripe fruits, each with the same probability, and starts from the task's ranges."""
        world, indices = self._world, env_idx.tolist()
        ripe = [world.plant_batch.ripe_fruits[i] for i in indices]
        targets = [int(fruits[rng.randint(len(fruits))]) for fruits, rng in zip(ripe, rngs, strict=True)]
        if "target" in options:
            if self._camera is not None:
                raise InvalidInputError(
                    "the reset option target is for ground truth; a robot with a camera chooses its target itself"
                )
            targets = [world.checked_target(i, options["target"]) for i in indices]
        if "viewpoint" in options:
            viewpoint, qpos = self._starts.given(options["viewpoint"], len(indices))
            world.set_target(env_idx, targets)
        else:
            world.set_target(env_idx, targets)
            viewpoint, qpos = self._starts.draw(rngs, world.target_position_w[env_idx])
        world.set_arm(env_idx, qpos, viewpoint)
        state = world.state
        # There is no view before the first one.
        state.fraction_before = state.fraction_before.index_fill(0, env_idx, math.nan)
        if self._camera is None:
            self.recall(env_idx)
        else:
            self._begin_camera(self._camera, env_idx, rngs)
        state.fraction_before = state.fraction_before.index_put((env_idx,), state.visible_fraction[env_idx])

    def _begin_camera(
        self, camera: CameraSenses, env_idx: Tensor, rngs: Sequence[np.random.RandomState]
    ) -> None:
        world, state = self._world, self._world.state
        for i, rng in zip(env_idx.tolist(), rngs, strict=True):
            camera.begin(i, rng, 0.0)
        for count in (state.looks, state.targets_begun, state.view_count):
            count[env_idx] = 0
        state.views[env_idx] = 0.0
        camera.begin_targets(env_idx)
        state.targets_begun[env_idx] = 1
        mask = torch.zeros(world.num_envs, dtype=torch.bool, device=world.device)
        mask[env_idx] = True
        self._measure(camera, new_view(world, mask))

    def known_target(self) -> Tensor:
        """Where the targets are, or where a camera located or seeks them, world frame, in [m]. Shape (N, 3)."""
        return self._world.target_position_w if self._camera is None else self._camera.known_target()

    def amend(self, plan: Plan, action: Tensor) -> Plan:
        """The plan as it is."""
        return plan

    def look(self, before: Tensor, plan: Plan | None) -> Plan | None:
        """Looks at the targets; a step is one look."""
        self._world.state.fraction_before = self._world.state.visible_fraction
        self._others_before = [view["visible_fraction"] for view in self._views_of_others]
        if self._camera is None:
            self._look()
        else:
            self._measure(self._camera, new_view(self._world, None))
        return None

    def recall(self, env_idx: Tensor) -> None:
        """Looks from where the arms are; with a camera from where they looked, so that all is known that was known."""
        if self._camera is not None:
            self._camera.recall_targets(env_idx)
            for view in remembered_views(self._world, env_idx):
                self._measure(self._camera, view)
            return
        if self._other_targets:
            self._others_before = []
            self._others, self._others_exist = _other_ripe_fruits(
                self._world.plant_batch.ripe_fruits, self._world.state.target, self._other_targets
            )
        mask = torch.zeros(self._world.num_envs, dtype=torch.bool, device=self._world.device)
        mask[env_idx] = True
        self._look(mask)

    def _look(self, mask: Tensor | None = None) -> None:
        """Looks from where the arms stand; without a mask of shape (N,) in all environments."""
        state = self._world.state
        self._view = self._judge_truth(state.target, state.fraction_before, mask, self._view)
        state.visible_fraction = self._view["visible_fraction"]
        if self._other_targets:
            others = self._others.unbind(-1)
            before = self._others_before or [state.fraction_before] * len(others)
            views = self._views_of_others or [{}] * len(others)
            self._views_of_others = [
                self._judge_truth(fruit, earlier, mask, view)
                for fruit, earlier, view in zip(others, before, views, strict=True)
            ]

    def _measure(self, camera: CameraSenses, view: ViewPoses) -> None:
        """Takes in a camera's view of some environments."""
        measured, _ = camera.look(view)
        if view.mask is not None and self._measured is not None:
            measured = measured.where(view.mask, self._measured)
        self._measured = measured
        self._world.state.visible_fraction = measured.visible_fraction
        self._view = self._judge(
            measured.visible_fraction,
            measured.told_fraction > 0.0,
            camera.ripe_detected,
            self._world.state.fraction_before,
            camera.known_target(),
        ) | camera_info(measured, self.task.full_visibility)

    def _judge_truth(
        self, target: Tensor, before: Tensor, mask: Tensor | None, last: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """The present view as one of `target`, indices in `Plant.fruits`, of which V_f was `before`; where the mask is
        False, and there was a last view, that one. Each of shape (N,)."""
        world = self._world
        mask = mask if last else None
        seen = world.scene.visibility(
            world.T_w_camera, target, world.plant_batch.T_world_plant, world.T_w_links, mask
        )
        fraction, tomato_seen = seen.visible_fraction, seen.any_visible
        if mask is not None:
            fraction = torch.where(mask, fraction, last["visible_fraction"])
            tomato_seen = torch.where(mask, tomato_seen, last["tomato_seen"])
        position = world.target_position_w
        if target is not world.state.target and self.task.own.success is not None:
            position = world.plant_batch.fruit_position_w(target)
        return self._judge(fraction, fraction > 0.0, tomato_seen, before, position)

    def _judge(
        self, fraction: Tensor, target_seen: Tensor, tomato_seen: Tensor, before: Tensor, position: Tensor
    ) -> dict[str, Tensor]:
        """A view by V_f, whether the target is seen, whether any ripe tomato is, V_f before, and where the target is.

        Each of shape (N,), the last (N, 3).
        """
        state = self._world.state
        forbidden = in_forbidden_zone(state.viewpoint[:, :3])
        unreachable = state.reach == int(Reach.UNREACHABLE)
        fail = unreachable if self.task.outside_workspace == "end" else torch.zeros_like(unreachable)
        judged = {
            "success": (fraction > self.task.full_visibility) & ~fail,
            "fail": fail,
            "visible_fraction": fraction,
            "target_seen": target_seen,
            "tomato_seen": tomato_seen,
            "reachability": state.reach.clone(),
            "in_forbidden_zone": forbidden,
            "reward_visual": self.task.visual_reward(fraction, target_seen, tomato_seen, state.reach),
            "reward_penalty": self.task.pose_penalty(state.reach, forbidden),
        }
        if self.task.own.success is not None:
            judged["success"] = self.task.own.success_of(self._moved(judged, before, position)) & ~fail
        return judged

    def _moved(self, judged: Mapping[str, Tensor], before: Tensor, position: Tensor) -> Moved:
        """What own rules judge."""
        world, state = self._world, self._world.state
        return Moved(
            info=judged,
            visible_fraction=judged["visible_fraction"],
            previous_fraction=torch.where(before.isnan(), judged["visible_fraction"], before),
            viewpoint=state.viewpoint,
            qpos=state.qpos,
            camera_position=world.T_w_camera[:, :3, 3],
            target_position=position,
        )

    @property
    def observation_size(self) -> int:
        """The nine numbers of the thesis."""
        return 9

    def observation(self) -> dict[str, Tensor]:
        """The nine numbers of the thesis by name."""
        viewpoint = self._world.state.viewpoint
        return {
            "ee_position": viewpoint[:, :3].clone(),
            "ee_rpy": viewpoint[:, 3:].clone(),
            "target_position": self.known_target().clone(),
        }

    def info(self) -> dict[str, Tensor]:
        """What the camera sees, and the terms of the reward."""
        info = {name: value.clone() for name, value in self._view.items()}
        info["target_id"] = self._world.target_id
        if self._other_targets:
            info |= self._info_of_others()
        return info

    def _info_of_others(self) -> dict[str, Tensor]:
        judged = self._views_of_others
        position = self._world.plant_batch.fruit_position_w
        places = [position(fruit) for fruit in self._others.unbind(-1)]
        before = self._others_before or [view["visible_fraction"] for view in judged]
        rewards = [self._reward(*of_one) for of_one in zip(judged, before, places, strict=True)]
        return {
            "other_visible_fraction": torch.stack([j["visible_fraction"] for j in judged], dim=-1),
            "other_success": torch.stack([j["success"] for j in judged], dim=-1),
            "other_reward": torch.stack(rewards, dim=-1),
            "other_exists": self._others_exist.clone(),
            "other_position": torch.stack(places, dim=-2),
        }

    def reward(self, info: Mapping[str, Tensor]) -> Tensor:
        """R = R_v + P_p, or the task's own reward. Shape (N,)."""
        return self._reward(info, self._world.state.fraction_before, self.known_target())

    def _reward(self, judged: Mapping[str, Tensor], before: Tensor, position: Tensor) -> Tensor:
        if self.task.own.reward is not None:
            return self.task.own.reward_of(self._moved(judged, before, position))
        return self.task.reward(judged["reward_visual"], judged["reward_penalty"])


def _other_ripe_fruits(
    ripe_fruits: Sequence[Sequence[int]], target: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """The ripe fruits that follow the target in the order of the plant's, the first again after the last.

    The order makes the choice repeatable without a random draw, and as even as that of the target.

    Args:
        ripe_fruits: Indices of the ripe fruits of each environment's plant.
        target: Index of each environment's target in `Plant.fruits`. Shape (N,).
        count: How many.

    Returns:
        Their indices, that of the target where the plant has fewer, and whether there is such a fruit. Both of
        shape (N, count), the latter bool.
    """
    fruits, exist = [], []
    for ripe, own in zip(ripe_fruits, target.tolist(), strict=True):
        at = ripe.index(own) if own in ripe else -1
        others = [fruit for fruit in (*ripe[at + 1 :], *ripe[: max(at, 0)]) if fruit != own][:count]
        missing = count - len(others)
        fruits.append(others + [own] * missing)
        exist.append([True] * len(others) + [False] * missing)
    device = target.device
    return torch.tensor(fruits, device=device), torch.tensor(exist, device=device)
