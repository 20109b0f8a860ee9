"""The rules of the general tasks: a hidden tomato, a memory of what was seen, a reward for every gain in V_f.

With a `TargetSequence` all ripe fruits of a row in reach are looked for, one after the other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.plants.episode_list import Episode
from maniskill_tomato.plants.row import Row
from maniskill_tomato.robot.look_at import camera_to_viewpoint
from maniskill_tomato.robot.rotations import FORWARD_RPY
from maniskill_tomato.robot.transit import TRANSIT_MOVES
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.observation import ObservationLayout, ViewpointObserver
from maniskill_tomato.sensing.perception_kinds import Perception
from maniskill_tomato.sensing.sensor_noise import SensorNoise
from maniskill_tomato.tasks import MAX_ROW_STEPS
from maniskill_tomato.tasks.arm_moves import Plan
from maniskill_tomato.tasks.own_rules import Moved
from maniskill_tomato.tasks.row.episode_selection import EpisodeChoice
from maniskill_tomato.tasks.row.hidden_starts import HardStarts, Start, StartRequest
from maniskill_tomato.tasks.row.inspecting import InspectedSequence, InspectingSenses
from maniskill_tomato.tasks.row.row_config import GeneralTaskConfig
from maniskill_tomato.tasks.row.target_sequence import TargetSequence, Transits, with_transits
from maniskill_tomato.tasks.senses import (
    CameraConfig,
    CameraSenses,
    ExactSenses,
    Senses,
    ViewMeasurement,
    ViewPoses,
    camera_info,
    check_pictures,
    new_view,
    remembered_views,
)
from maniskill_tomato.tasks.world import World


class SearchGame:
    """The general task, and the row where `transits` says how arms get from target to target."""

    keeps_belief = True
    saved_columns: tuple[str, ...] = tuple(
        "viewpoint reach target plant_pose plant_seed views view_count looks moves clearance path_length "
        "joint_path_length fraction_before fraction_after noise_seed position_error hidden_below open_targets "
        "targets_begun seen_count target_count target_moves target_done transits".split()
    )

    def __init__(
        self,
        world: World,
        task: GeneralTaskConfig,
        *,
        episodes: EpisodeChoice,
        layout: ObservationLayout,
        noise: SensorNoise,
        perception: Perception,
        camera: CameraConfig,
        transits: Transits | None,
    ) -> None:
        """Plays in a world.

        Args:
            world: The plants and arms.
            task: Starts, thresholds and rewards.
            episodes: A fixed list, if there is one.
            layout: What the observation holds.
            noise: What is wrong with exact labels.
            perception: Where labels and V_f come from.
            camera: How targets are named to a robot with a camera.
            transits: When arms go by their ready posture in a row; None for the task with one target.
        """
        self.task = task
        self.layout = layout
        self.episodes = episodes
        self._world = world
        self._observer = ViewpointObserver(world.num_envs, world.device, layout, task.max_moves)
        self._is_camera = perception != "ground_truth"
        self._starts = HardStarts(task, world.scene, world.device)
        self._senses: Senses
        self.sequence: TargetSequence | None = None
        lattice = self._observer.lattice
        if not self._is_camera:
            self._senses = ExactSenses(world, noise)
            self.sequence = None if transits is None else TargetSequence(world, lattice, transits)
        else:
            check_pictures(perception, world)
            if transits is None:
                self._senses = CameraSenses(world, perception, camera, task.full_visibility)
            else:
                inspecting = InspectingSenses(world, perception, camera, task.full_visibility)
                self._senses = inspecting
                self.sequence = InspectedSequence(world, lattice, transits, inspecting)
        self._measured: ViewMeasurement | None = None
        self._seen_from = torch.zeros(0)
        """Poses of the cameras at the last views. Shape (N, 4, 4)."""
        self.soft_starts = 0
        """Episodes so far that no drawn start made as hard as asked for."""

    # ---------------------------------------------------------------- episode

    @property
    def perception(self) -> CameraPerception:
        """What a camera has measured.

        Raises:
            AttributeError: There is none.
        """
        perception: CameraPerception = self._senses.perception  # type: ignore[attr-defined]
        return perception

    @property
    def belief(self) -> Belief:
        """What is known after the last look."""
        return replace(self._observer.belief, images=self._world.images)

    def episode(self, env_index: int, options: Mapping[str, Any]) -> Episode | None:
        """The episode of the list that a reset with these options begins; None without a list."""
        return self.episodes.at(env_index, self._world.seeds[env_index], options)

    def draw_plant(self, env_index: int, rng: np.random.RandomState, options: Mapping[str, Any]) -> int:
        """The seed of an environment's next plant, the first draw of its episode."""
        episode = self.episode(env_index, options)
        if episode is not None:
            return episode.plant_seed
        return self._world.plant_batch.spec.draw_seed(rng)

    def begin(
        self, env_idx: Tensor, rngs: Sequence[np.random.RandomState], options: Mapping[str, Any]
    ) -> None:
        """Begins with a hidden target each, or with the episodes of the list."""
        world, state, indices = self._world, self._world.state, env_idx.tolist()
        episodes = [self.episode(i, options) for i in indices]
        listed = [e for e in episodes if e is not None]
        if listed:
            world.place_plants(env_idx, np.array([e.plant_pose for e in listed]))
        starts = self._draw_starts(indices, rngs, episodes, options)
        self.soft_starts += sum(not start.is_hard for start in starts)
        world.set_target(env_idx, [start.target for start in starts])
        poses = torch.stack([start.T_world_camera for start in starts]).double()
        near = torch.tensor([FORWARD_RPY], dtype=torch.float64, device=world.device).expand(len(starts), 3)
        viewpoint = camera_to_viewpoint(poses, near).float()
        world.set_arm(env_idx, torch.stack([start.qpos for start in starts]), viewpoint)
        for i, rng, start in zip(indices, rngs, starts, strict=True):
            hidden = start.is_hard and options.get("camera_position") is None
            self._senses.begin(i, rng, self.task.start_visibility[1] if hidden else 0.0)
        for column in (state.moves, state.looks, state.targets_begun, state.transits):
            column[env_idx] = 0
        for length in (state.path_length, state.joint_path_length):
            length[env_idx] = 0.0
        clearance = world.scene.clearance_at(
            state.qpos[env_idx], world.plant_batch.T_world_plant[env_idx], env_idx
        )
        state.clearance[env_idx] = clearance
        if self.sequence is not None:
            self.sequence.begin(env_idx)
        self._forget(env_idx)
        self._begin_targets(env_idx)
        started = self._mask(env_idx)
        first = state.visible_fraction
        state.fraction_before = torch.where(started, first, state.fraction_before)
        state.fraction_after = torch.where(started, first, state.fraction_after)

    def _candidates(self, indices: Sequence[int]) -> list[list[int]]:
        """The fruits of some environments that can become targets."""
        if self.sequence is not None:
            return self.sequence.in_reach(indices)
        plant_batch = self._world.plant_batch
        candidates = []
        for i in indices:
            plant, ripe = plant_batch.plants[i], plant_batch.ripe_fruits[i]
            middle = plant.middle_fruits if isinstance(plant, Row) else len(plant.fruits)
            candidates.append([j for j in ripe if j < middle])
        return candidates

    def _draw_starts(
        self,
        indices: Sequence[int],
        rngs: Sequence[np.random.RandomState],
        episodes: Sequence[Episode | None],
        options: Mapping[str, Any],
    ) -> list[Start]:
        """Starts of some environments: the options', those of the list's episodes, or drawn ones."""
        world, plant_batch = self._world, self._world.plant_batch
        listed = [episode for episode in episodes if episode is not None]
        if "target" in options:
            targets = [[world.checked_target(i, options["target"])] for i in indices]
        else:
            targets = [[episode.target] for episode in listed] or self._candidates(indices)
        positions: Sequence[object] = [episode.camera_position for episode in listed]
        if options.get("camera_position") is not None:
            positions = [options["camera_position"]] * len(indices)
        if positions:
            chosen = [
                t[int(rng.randint(len(t))) if len(t) > 1 else 0] for t, rng in zip(targets, rngs, strict=True)
            ]
            centres = [
                plant_batch.fruit_positions_w(i, [fruit])[0] for i, fruit in zip(indices, chosen, strict=True)
            ]
            return self._starts.given(positions, chosen, torch.stack(centres))
        requests = [
            StartRequest(i, rng, t, plant_batch.fruit_positions_w(i, t))
            for i, rng, t in zip(indices, rngs, targets, strict=True)
        ]
        return self._starts.draw(requests, plant_batch.T_world_plant)

    def _forget(self, env_idx: Tensor) -> None:
        """Begins with other targets. Shape (b,)."""
        self._senses.begin_targets(env_idx)
        self._world.state.targets_begun[env_idx] += 1

    def _begin_targets(self, env_idx: Tensor) -> None:
        """Takes a first look at the targets of some environments, of which nothing is known. Shape (b,)."""
        state = self._world.state
        self._observer.begin(env_idx, self.known_target()[env_idx])
        state.view_count[env_idx] = 0
        state.views[env_idx] = 0.0
        self._look(self._mask(env_idx))

    def _mask(self, env_idx: Tensor) -> Tensor:
        mask = torch.zeros(self._world.num_envs, dtype=torch.bool, device=self._world.device)
        mask[env_idx] = True
        return mask

    # ------------------------------------------------------------------- step

    def known_target(self) -> Tensor:
        """Where the targets are believed to be, world frame, in [m]. Shape (N, 3)."""
        return self._senses.known_target()

    def amend(self, plan: Plan, action: Tensor) -> Plan:
        """The plan, with a transit where a row's look-at move is refused."""
        if self.sequence is None or self._world.moves.control != "look_at":
            return plan
        return self.sequence.ways_of_refused(plan, action, self.known_target())

    def look(self, before: Tensor, plan: Plan | None) -> Plan | None:
        """Counts a move, or a turn to the next target, and looks."""
        if plan is not None and plan.turned is not None:
            self._count_transits(plan)
            self._begin_targets(plan.turned)
            return None
        state = self._world.state
        state.fraction_before = state.visible_fraction
        state.transits = torch.zeros_like(state.transits)
        self._count_move(before, plan)
        self._look(None)
        state.fraction_after = state.visible_fraction
        return None if self.sequence is None else self._turn(self.sequence)

    def _count_move(self, before: Tensor, plan: Plan | None) -> None:
        """Clearance, way and number of the last move."""
        world, state = self._world, self._world.state
        ways = {} if plan is None else plan.transits
        T_w_camera, qpos = world.T_w_camera, state.qpos
        if ways:
            # These went another way, which is counted below.
            qpos = qpos.clone()
            rows = list(ways)
            qpos[rows] = before[rows]
            T_w_camera = T_w_camera.clone()
            T_w_camera[rows] = self._seen_from[rows]
        state.clearance = world.scene.clearance_along(before, qpos, world.plant_batch.T_world_plant)
        moved = (T_w_camera[:, :3, 3] - self._seen_from[:, :3, 3]).norm(dim=-1)
        state.path_length = state.path_length + moved
        state.moves = state.moves + 1
        if self.sequence is not None:
            state.joint_path_length = state.joint_path_length + (qpos - before).abs().sum(-1)
            state.target_moves = state.target_moves + 1
        if plan is not None:
            self._count_transits(plan)

    def _count_transits(self, plan: Plan) -> None:
        world, state = self._world, self._world.state
        for i, way in plan.transits.items():
            passed = way.passed.float()
            legs = len(passed) - 1
            T_w_plant = world.plant_batch.T_world_plant[i].expand(legs, 4, 4)
            env_idx = torch.full((legs,), i, device=world.device)
            clearance = world.scene.clearance_along(passed[:-1], passed[1:], T_w_plant, env_idx).min()
            state.clearance[i] = torch.minimum(state.clearance[i], clearance)
            state.path_length[i] += way.camera_path_m
            state.joint_path_length[i] += way.joint_path_rad
            state.moves[i] += TRANSIT_MOVES
            state.target_moves[i] += TRANSIT_MOVES
            state.transits[i] += 1

    def _turn(self, sequence: TargetSequence) -> Plan | None:
        """The turn to the next targets after a move; None where all go on with theirs."""
        state = self._world.state
        turned = sequence.finish(self.task.full_visibility, self.task.max_moves)
        if not turned:
            return None
        env_idx = torch.tensor(turned, device=self._world.device)
        self._forget(env_idx)
        known = self.known_target()
        ways = {i: way for i in turned if (way := sequence.way_to_next(i, known[i])) is not None}
        stay = Plan(target_qpos=state.qpos, reach=state.reach, viewpoint=state.viewpoint, turned=env_idx)
        return with_transits(stay, ways)

    def _moves_left(self) -> Tensor:
        state = self._world.state
        if self.sequence is None:
            return (self.task.max_moves - state.moves).clamp_min(0)
        left = torch.minimum(self.task.max_moves - state.target_moves, MAX_ROW_STEPS - state.moves)
        return left.clamp_min(0)

    def _look(self, mask: Tensor | None) -> None:
        """Looks from where the arms stand and takes the view into the memory, once for every view."""
        self._sense(new_view(self._world, mask))

    def _sense(self, view: ViewPoses) -> None:
        """Senses one view of some environments and observes it."""
        state, mask = self._world.state, view.mask
        measured, located = self._senses.look(view)
        seen_from = view.T_w_camera
        if mask is not None and self._measured is not None:
            measured = measured.where(mask, self._measured)
            seen_from = torch.where(mask[:, None, None], seen_from, self._seen_from)
        self._measured, self._seen_from = measured, seen_from
        state.visible_fraction = measured.visible_fraction
        if located is not None and len(located):
            # What was seen before stood about the place where the target was thought to be.
            self._senses.revise(self._observer, located)
        self._observer.observe(
            state.viewpoint,
            seen_from,
            measured.rays,
            measured.told_fraction,
            self._moves_left(),
            mask,
            state.qpos,
        )

    def recall(self, env_idx: Tensor) -> None:
        """Looks again from where some environments looked, so that all is known of their targets that was known."""
        self._senses.recall_targets(env_idx)
        self._observer.begin(env_idx, self.known_target()[env_idx])
        for view in remembered_views(self._world, env_idx):
            self._sense(view)

    # ---------------------------------------------------------------- outcome

    @property
    def observation_size(self) -> int:
        """Numbers of the observer's vector."""
        return self.layout.size

    def observation(self) -> dict[str, Tensor]:
        """The parts of the observer's vector."""
        vector = self._observer.belief.observation
        return {str(name): vector[:, part].clone() for name, part in self.layout.slices.items()}

    def info(self) -> dict[str, Tensor]:
        """What came of the last move: V_f, whether that is a success, what it touched, how much of a row is done."""
        state, measured = self._world.state, self._measured
        assert measured is not None
        fraction = state.fraction_after
        info = {
            "success": fraction > self.task.full_visibility,
            "fail": torch.zeros_like(fraction, dtype=torch.bool),
            "visible_fraction": fraction.clone(),
            "visible_fraction_gain": fraction - state.fraction_before,
            "target_id": self._world.target_id,
            "target_seen": fraction > 0.0,
            "tomato_seen": measured.tomato_seen.clone(),
            "reachability": state.reach.clone(),
            "clearance": state.clearance.clone(),
            "plant_contact": state.clearance <= 0.0,
            "moves": state.moves.clone(),
            "path_length": state.path_length.clone(),
        }
        if self._is_camera:
            info |= camera_info(measured, self.task.full_visibility)
        if self.sequence is not None:
            info["success"] = self.sequence.is_success()
            over = self.sequence.is_over() | (state.moves >= MAX_ROW_STEPS)
            info["fail"] = over & ~info["success"]
            info["seen_count"] = state.seen_count.clone()
            info["target_count"] = state.target_count.clone()
            info["target_done"] = state.target_done.clone()
            info["transits"] = state.transits.clone()
            info["joint_path_length"] = state.joint_path_length.clone()
        if self.task.own.success is not None:
            info["success"] = self.task.own.success_of(self._moved(info))
        return info

    def _moved(self, info: Mapping[str, Tensor]) -> Moved:
        """What own rules judge."""
        world, state = self._world, self._world.state
        return Moved(
            info=info,
            visible_fraction=state.fraction_after,
            previous_fraction=state.fraction_before,
            viewpoint=state.viewpoint,
            qpos=state.qpos,
            camera_position=world.T_w_camera[:, :3, 3],
            target_position=self.known_target(),
        )

    def reward(self, info: Mapping[str, Tensor]) -> Tensor:
        """The reward of the last move; in a row each target that was seen is a success, and transits cost what their
        moves do. Shape (N,)."""
        if self.task.own.reward is not None:
            return self.task.own.reward_of(self._moved(info))
        state = self._world.state
        success = info["success"] if self.sequence is None else info["target_done"]
        reward = self.task.reward(state.fraction_after, state.fraction_before, success, info["plant_contact"])
        if self.sequence is None:
            return reward
        return reward - self.task.step_cost * TRANSIT_MOVES * info["transits"]
