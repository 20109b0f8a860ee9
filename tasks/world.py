"""N viewpoint games at once on any torch device, without a simulator.

A step is plan, move, look: `World.plan` says where the arms should go, a shell moves them (or the world itself sets the
joints), and `World.look` measures from where they are. `World.step` does all three.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.growers import PlantGrowers
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.plants.spec import PlantPose, PlantSpec
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.d435 import CameraIntrinsics, T_flange_camera_color_optical
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.look_at import carried_pose
from maniskill_tomato.robot.robot_description import link_meshes
from maniskill_tomato.robot.viewpoint_move import viewpoint_of
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.image_observation import cast_images
from maniskill_tomato.tasks.arm_moves import ACTION_SIZES, CONTROL_MODES, ArmMoves, Plan
from maniskill_tomato.tasks.ground_truth import WorldTruth
from maniskill_tomato.tasks.numpy_streams import (
    random_state,
    set_random_state,
    spread_seed,
)
from maniskill_tomato.tasks.plant_batch import PlantBatch
from maniskill_tomato.tasks.world_state import WorldState

FIRST_ORGAN_ID = 24
"""Segmentation id of a plant's first organ in a scene of the robot's links, floor and walls."""

FIRST_SEED = 2022
"""Before it is seeded, environment i has the generator of this plus i, as in ManiSkill."""

Pictures = Callable[[Tensor], NDArray[np.uint8]]
"""Renders the colours that all wrist cameras see, by the joint positions of shape (N, 7), in [rad]; gives an array
of shape (N, H, W, 3)."""


class TaskConfig(Protocol):
    """What every task says about itself."""

    @property
    def plant(self) -> PlantSpec:
        """The plants that it uses unless it is given others."""
        ...

    @property
    def plant_pose(self) -> PlantPose:
        """Where they stand."""
        ...

    @property
    def full_visibility(self) -> float:
        """The target is fully visible when V_f is above this."""
        ...

    @property
    def largest_reward(self) -> float:
        """Of one step."""
        ...


class Game(Protocol):
    """What tells one family of tasks from another: starts, what is seen and known, reward, end."""

    task: Any
    """Its configuration, a `TaskConfig`."""
    keeps_belief: bool
    """Whether it has a `belief`, for policies that decide from it."""
    saved_columns: tuple[str, ...]
    """The columns of the state from which an episode can be taken up again."""

    def draw_plant(self, env_index: int, rng: np.random.RandomState, options: Mapping[str, Any]) -> int:
        """The seed of an environment's next plant, the first draw of its episode."""
        ...

    def begin(
        self, env_idx: Tensor, rngs: Sequence[np.random.RandomState], options: Mapping[str, Any]
    ) -> None:
        """Begins episodes where the plants stand already: target, arm, first look. Shape (b,)."""
        ...

    def known_target(self) -> Tensor:
        """Where the targets are believed to be, world frame, in [m]. Shape (N, 3)."""
        ...

    def amend(self, plan: Plan, action: Tensor) -> Plan:
        """The plan for an action with what the task adds to it."""
        ...

    def look(self, before: Tensor, plan: Plan | None) -> Plan | None:
        """Counts a move from the joint positions `before` and looks; returns the next plan of the step, if any."""
        ...

    def recall(self, env_idx: Tensor) -> None:
        """Works out again what follows from the state of some environments, and looks at the present view."""
        ...

    @property
    def observation_size(self) -> int:
        """Numbers of an environment's observation."""
        ...

    def observation(self) -> dict[str, Tensor]:
        """The parts of the observation by name, each of shape (N, D)."""
        ...

    def info(self) -> dict[str, Tensor]:
        """What came of the last move, with `success` and `fail`; each of shape (N, ...)."""
        ...

    def reward(self, info: Mapping[str, Tensor]) -> Tensor:
        """The reward of the move that `info` tells about. Shape (N,)."""
        ...


class World:
    """N environments of one task."""

    def __init__(
        self,
        make_game: Callable[["World"], Game],
        *,
        moves: ArmMoves,
        plant: PlantSpec,
        plant_pose: PlantPose,
        plant_pose_noise: Sequence[float],
        intrinsics: CameraIntrinsics,
        rays_per_side: int = 16,
        num_envs: int = 1,
        device: str | torch.device = "cpu",
        pictures: Pictures | None = None,
    ) -> None:
        """Grows the first plant; `reset` begins episodes.

        Args:
            make_game: Makes the task's rules over this world.
            moves: What an action does.
            plant: The plants.
            plant_pose: Where they stand.
            plant_pose_noise: Half ranges of a uniform addition to it at every reset, in [m, m, rad].
            intrinsics: Of the wrist's colour camera.
            rays_per_side: A visible fraction is counted with the square of this number of rays.
            num_envs: N.
            device: Where all tensors live.
            pictures: The renderer, where there is one.
        """
        if num_envs < 1:
            raise InvalidInputError(f"num_envs must be 1 or more; got {num_envs}")
        self.num_envs = num_envs
        self.device = torch.device(device)
        self.intrinsics = intrinsics
        self.pictures = pictures
        self.moves = moves
        self.state = WorldState.zeros(num_envs, self.device)
        self.plant_batch = PlantBatch(plant, self.state)
        self.swaps_plants = True
        """Whether a reset shows the plants that it draws; a shell whose scene holds them as actors does so itself."""
        self.first_organ_id = torch.full((num_envs,), FIRST_ORGAN_ID, dtype=torch.int32, device=self.device)
        """Segmentation id of each plant's first organ. Shape (N,), int32."""
        self.scene = RayScene(
            self.plant_batch.plants,
            intrinsics,
            robot_meshes=link_meshes(),
            rays_per_side=rays_per_side,
            device=str(self.device),
        )
        self._plant_pose, self._plant_pose_noise = plant_pose, np.array(plant_pose_noise, dtype=np.float64)
        self._T_ee_camera = torch.tensor(
            T_flange_camera_color_optical, dtype=torch.float64, device=self.device
        )
        self.rngs = [np.random.RandomState(FIRST_SEED + i) for i in range(num_envs)]
        """The random generator of each environment."""
        self.seeds = [FIRST_SEED + i for i in range(num_envs)]
        """What they were last seeded with."""
        self.target_position_w = torch.zeros(num_envs, 3, device=self.device)
        """Centres of the target fruits in the world frame, in [m]. Shape (N, 3)."""
        self.T_w_links = torch.zeros(0)
        """Poses of the arms' links. Shape (N, 9, 4, 4)."""
        self.T_w_camera = torch.zeros(0)
        """Poses of the cameras' optical frames. Shape (N, 4, 4)."""
        self.place_arms()
        self.game = make_game(self)
        self.ground_truth = WorldTruth(
            self.scene, self.plant_batch, self.state, float(self.task.full_visibility)
        )
        """What only a simulator knows; for policies that need the truth."""

    # ---------------------------------------------------------------- episode

    def reset(
        self,
        seed: int | Sequence[int] | None = None,
        env_idx: Tensor | Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Begins episodes.

        Args:
            seed: Of the generators, one for each environment of `env_idx`; of a single number the first has this one
                and the others what follows from it. None lets the generators go on.
            env_idx: Which environments, all if None. Shape (b,).
            options: `target` and what else the task takes.

        Raises:
            InvalidInputError: An option cannot be used.
        """
        rows = self.env_rows(env_idx)
        if seed is not None:
            indices = rows.tolist()
            self.seed(dict(zip(indices, spread_seed(seed, len(indices)), strict=True)))
        self.begin(rows, options or {})

    def seed(self, seeds: Mapping[int, int]) -> None:
        """Seeds the generators of some environments, by their index."""
        for i, seed in seeds.items():
            self.rngs[i], self.seeds[i] = np.random.RandomState(seed), seed

    def env_rows(self, env_idx: Tensor | Sequence[int] | None) -> Tensor:
        """Indices of environments as a tensor, all for None. Shape (b,).

        Raises:
            InvalidInputError: They are not indices of environments, each given once.
        """
        if env_idx is None:
            return torch.arange(self.num_envs, device=self.device)
        rows = torch.as_tensor(env_idx, device=self.device).reshape(-1)
        if rows.dtype == torch.bool and len(rows) == self.num_envs:
            return rows.nonzero()[:, 0]
        numbers = rows.tolist()
        whole = not rows.is_floating_point() and rows.dtype != torch.bool
        fits = whole and all(0 <= i < self.num_envs for i in numbers) and len(set(numbers)) == len(numbers)
        if numbers and not fits:
            raise InvalidInputError(
                f"env_idx must hold indices from 0 to {self.num_envs - 1}, each once; got {env_idx!r}"
            )
        return rows.long()

    def begin(self, env_idx: Tensor, options: Mapping[str, Any]) -> None:
        """Begins episodes with the generators as they are; see `reset`. Shape (b,)."""
        indices = env_idx.tolist()
        if not indices:
            return
        rngs = [self.rngs[i] for i in indices]
        if self.plant_batch.spec.changes:
            drawn = {i: self.game.draw_plant(i, rng, options) for i, rng in zip(indices, rngs, strict=True)}
            if self.swaps_plants:
                self.show_plants(drawn)
        pose, noise = self._plant_pose.as_array(), self._plant_pose_noise
        self.place_plants(env_idx, np.stack([pose + noise * rng.uniform(-1.0, 1.0, 3) for rng in rngs]))
        self.game.begin(env_idx, rngs, options)
        self._expect_plants(indices)

    def grow_ahead(self, processes: int) -> None:
        """Has the plants of coming resets grown by worker processes; the plants stay the same.

        An episode draws from its generator while it begins and not later, so that its next plant is known by then. It
        is another one only where a reset is given a seed.

        Args:
            processes: How many, at least 1; they end with `close`, with this object or with this process.
        """
        self.plant_batch.growers = PlantGrowers(self.plant_batch.spec, processes, self.scene.prepare)

    def close(self) -> None:
        """Ends the processes of `grow_ahead`, if there are any."""
        if self.plant_batch.growers is not None:
            self.plant_batch.growers.close()
            self.plant_batch.growers = None

    def _expect_plants(self, indices: Sequence[int]) -> None:
        """Has the next plants of some environments grown, if anybody grows plants ahead."""
        if self.plant_batch.growers is None:
            return
        seeds, ahead = {}, np.random.RandomState(0)
        for i in indices:
            ahead.set_state(self.rngs[i].get_state())
            seeds[i] = self.game.draw_plant(i, ahead, {})
        self.plant_batch.growers.expect(seeds)

    def show_plants(self, seeds: Mapping[int, int]) -> None:
        """Shows the plants of other seeds, by the index of the environment."""
        shown = self.plant_batch.seeds
        new = {i: seed for i, seed in seeds.items() if seed != shown[i]}
        if new:
            self.scene.replace_plants(self.plant_batch.show(new))

    def exchange_plants(self, plants: Mapping[int, Plant]) -> None:
        """Goes on with altered forms of the plants that are shown, by the index of the environment.

        All that was seen of the targets is seen again, from where the arms looked. An episode that begins later has the
        altered plant too, unless it has another seed.

        Args:
            plants: With as many fruits as before.

        Raises:
            InvalidInputError: A plant has other fruits.
        """
        for i, plant in plants.items():
            before = len(self.plant_batch.plants[i].fruits)
            if len(plant.fruits) != before:
                raise InvalidInputError(
                    f"the plant of environment {i} must have {before} fruits, got {len(plant.fruits)}"
                )
        self.plant_batch.put(plants)
        self.scene.replace_plants(plants)
        self._recall(torch.tensor(list(plants), dtype=torch.int64, device=self.device))

    def place_plants(self, env_idx: Tensor, poses: NDArray[np.float64]) -> None:
        """Puts plants at x, y [m] and yaw [rad]. Shape (b, 3)."""
        self.plant_batch.place(env_idx, torch.as_tensor(poses, dtype=torch.float32, device=self.device))

    def set_target(self, env_idx: Tensor, target: Sequence[int] | Tensor) -> None:
        """Chooses the targets of some environments, as indices in `Plant.fruits`. Shape (b,)."""
        self.state.target = self.state.target.clone()
        self.state.target[env_idx] = torch.as_tensor(target, dtype=torch.int64, device=self.device)
        self._look_up_targets()

    def set_arm(self, env_idx: Tensor, qpos: Tensor, viewpoint: Tensor) -> None:
        """Puts arms at the start of an episode.

        Args:
            env_idx: Which environments. Shape (b,).
            qpos: Joint positions, in [rad]. Shape (b, 7).
            viewpoint: The same as the flange's viewpoint; see `WorldState.viewpoint`. Shape (b, 6).
        """
        state = self.state
        state.qpos, state.viewpoint, state.reach = (
            state.qpos.clone(),
            state.viewpoint.clone(),
            state.reach.clone(),
        )
        state.qpos[env_idx], state.viewpoint[env_idx] = qpos, viewpoint
        state.reach[env_idx] = int(Reach.REACHABLE)
        self.place_arms()

    def checked_target(self, env_index: int, target: object) -> int:
        """The reset option `target`.

        Raises:
            InvalidInputError: It is no ripe fruit of the environment's plant.
        """
        ripe = self.plant_batch.ripe_fruits[env_index]
        if isinstance(target, bool) or not isinstance(target, int) or target not in ripe:
            raise InvalidInputError(
                f"reset option target must be a ripe fruit of the plant, one of {ripe}; got {target!r}"
            )
        return target

    # ------------------------------------------------------------------- step

    @property
    def control_mode(self) -> str:
        """What an action is, in ManiSkill's words."""
        return next(name for name, control in CONTROL_MODES.items() if control == self.moves.control)

    def check_action(self, action: Any) -> Tensor:
        """Actions as a tensor of shape (N, A), float32.

        Raises:
            InvalidInputError: They are no finite numbers of that shape, or (A,) for one environment.
        """
        return check_action(action, self.num_envs, ACTION_SIZES[self.moves.control], self.device)

    def plan(self, action: Tensor) -> Plan:
        """Where the arms should go. Shape (N, A)."""
        state = self.state
        plan = self.moves.plan(state.qpos, state.viewpoint, self.game.known_target(), action)
        return self.game.amend(plan, action)

    def look(self, qpos: Tensor, plan: Plan | None = None) -> Plan | None:
        """Looks from where the arms are.

        Args:
            qpos: Joint positions, in [rad]. Shape (N, 7).
            plan: What was to be done, None if somebody else moved the arms.

        Returns:
            What is to be done next in the same step; None when the step is complete.
        """
        state = self.state
        before = state.qpos
        if plan is None:
            state.viewpoint = viewpoint_of(qpos, state.viewpoint[:, 3:])
            state.reach = torch.full_like(state.reach, int(Reach.REACHABLE))
        elif plan.turned is None or plan.transits:
            state.viewpoint = self._viewpoint_reached(qpos, plan)
            if plan.turned is None:
                state.reach = plan.reach
        state.qpos = qpos
        self.place_arms()
        return self.game.look(before, plan)

    def step(self, action: Any, move: Callable[[Plan], Tensor] | None = None) -> None:
        """Makes a move in every environment.

        Args:
            action: Shape (N, A).
            move: Follows a plan and returns the joint positions where the arms then are, of shape (N, 7); if None they
                are set.

        Raises:
            InvalidInputError: The action cannot be used; nothing was changed.
        """
        size = ACTION_SIZES[self.moves.control]
        batch = action_batch(action, self.num_envs, size, self.device)
        # The inverse kinematics refuses NaN, and asks the device for that once. To ask here too would wait twice.
        batch = batch.nan_to_num(math.nan, math.nan, math.nan)
        try:
            plan = self.plan(batch)
        except InvalidInputError:
            check_finite(batch)
            raise
        self._finish(plan, move)

    def arrive(self, qpos: Tensor, move: Callable[[Plan], Tensor] | None = None) -> None:
        """A step in which somebody else moved the arms to joint positions of shape (N, 7), in [rad]."""
        self._finish(self.look(qpos), move)

    def _finish(self, plan: Plan | None, move: Callable[[Plan], Tensor] | None) -> None:
        while plan is not None:
            plan = self.look(plan.target_qpos if move is None else move(plan), plan)

    def _viewpoint_reached(self, qpos: Tensor, plan: Plan) -> Tensor:
        if qpos is plan.target_qpos and not plan.transits:
            return plan.viewpoint
        exact = (qpos == plan.target_qpos).all(-1)
        for i in plan.transits:
            exact[i] = False
        if bool(exact.all()):
            return plan.viewpoint
        return torch.where(exact[:, None], plan.viewpoint, viewpoint_of(qpos, plan.viewpoint[:, 3:]))

    def place_arms(self) -> None:
        """Works out where links and cameras are."""
        self.T_w_links = link_transforms(self.state.qpos)
        self.T_w_camera = self.camera_poses(self.T_w_links)

    def camera_poses(self, T_w_links: Tensor) -> Tensor:
        """Poses of the optical frames for poses of the links. Shape (N, 9, 4, 4) to (N, 4, 4)."""
        return carried_pose(T_w_links[:, -1], self._T_ee_camera)

    # ---------------------------------------------------------------- outcome

    @property
    def task(self) -> Any:
        """The task's configuration."""
        return self.game.task

    @property
    def qpos(self) -> Tensor:
        """Joint positions, in [rad]. Shape (N, 7)."""
        return self.state.qpos.clone()

    @property
    def target_fruit(self) -> Tensor:
        """Index of the target in `Plant.fruits`. Shape (N,)."""
        return self.state.target.clone()

    @property
    def target_id(self) -> Tensor:
        """Segmentation id of the target. Shape (N,), int32."""
        return self._target_id.clone()

    def _look_up_targets(self) -> None:
        """Works out where the targets are and what they are called in pictures."""
        self.target_position_w = self.plant_batch.fruit_position_w(self.state.target)
        self._target_id = (self.first_organ_id + self.plant_batch.fruit_organ(self.state.target)).int()

    @property
    def keeps_belief(self) -> bool:
        """Whether there is a `belief`; the general tasks alone have one."""
        return self.game.keeps_belief

    @property
    def belief(self) -> Belief:
        """What is known after the last look, for policies.

        Raises:
            AttributeError: The task keeps none.
            InvalidInputError: No episode has begun.
        """
        belief: Belief = self.game.belief  # type: ignore[attr-defined]
        return belief

    @property
    def open_targets(self) -> Callable[[int], list[int]]:
        """Tells the fruits of an environment's row that are yet to be looked for, as indices in `Plant.fruits`; tasks
        with one target have no such attribute."""
        sequence = getattr(self.game, "sequence", None)
        if sequence is None:
            raise AttributeError("open_targets")
        told: Callable[[int], list[int]] = sequence.open_targets
        return told

    @property
    def targets_begun(self) -> Tensor:
        """How many targets each episode has had so far. Shape (N,)."""
        return self.state.targets_begun.clone()

    @property
    def inspecting(self) -> Any:
        """The `InspectingSenses` of a row that is inspected with a camera; other tasks have no such attribute."""
        senses = getattr(getattr(self.game, "sequence", None), "senses", None)
        if senses is None:
            raise AttributeError("inspecting")
        return senses

    def fruit_position_w(self, env_index: int, fruit: int) -> Tensor:
        """Centre of a fruit in the world frame, in [m]. Shape (3,)."""
        return self.plant_batch.fruit_positions_w(env_index, [fruit])[0]

    def observation(self) -> Tensor:
        """The observation of state vectors. Shape (N, D)."""
        return torch.cat(tuple(self.game.observation().values()), dim=-1)

    def images(self, layout: ImageLayout) -> dict[str, Tensor]:
        """What the wrist cameras show: of a camera's perception what it measured, else the truth.

        Args:
            layout: What is wanted.

        Returns:
            By kind, each of shape (N, H, W, C).

        Raises:
            InvalidInputError: Colours are wanted, and the world has no renderer.
        """
        perception: CameraPerception | None = getattr(self.game, "perception", None)
        if perception is not None:
            return perception.images(layout)
        cast = self.scene.image(
            layout.intrinsics(self.intrinsics),
            self.T_w_camera,
            self.state.target,
            self.plant_batch.T_world_plant,
            self.T_w_links,
        )
        colours = self.pictures(self.state.qpos) if layout.needs_colours and self.pictures else None
        return cast_images(cast, layout, colours)

    def info(self) -> dict[str, Tensor]:
        """What came of the last move."""
        return self.game.info()

    def reward(self, info: Mapping[str, Tensor] | None = None) -> Tensor:
        """The reward of the last move. Shape (N,)."""
        return self.game.reward(self.game.info() if info is None else info)

    # ------------------------------------------------------------------ state

    def saved_rows(self) -> dict[str, Tensor]:
        """The part of the state from which the episodes can be taken up again, by name; each (N, D), float32."""
        return self.state.rows(self.game.saved_columns)

    def take_up(self, env_idx: Tensor, rows: Mapping[str, Tensor], qpos: Tensor) -> None:
        """Takes back rows of `saved_rows`, with the same plants, whose joint positions are given.

        Args:
            env_idx: Which environments. Shape (b,).
            rows: Each of shape (b, D).
            qpos: Joint positions, in [rad]. Shape (b, 7).
        """
        self.state.put(env_idx, rows)
        self.state.qpos = self.state.qpos.clone()
        self.state.qpos[env_idx] = qpos
        self._recall(env_idx)

    def save(self) -> dict[str, Any]:
        """Everything that decides how the world goes on: tensors, numbers and text."""
        return {
            "state": self.state.save(),
            "seeds": list(self.seeds),
            "generators": [random_state(rng) for rng in self.rngs],
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Takes back what `save` of a world made with the same options gave.

        Raises:
            InvalidInputError: It does not fit.
        """
        self.show_plants(dict(enumerate(saved["state"]["plant_seed"].tolist())))
        self.state.restore(saved["state"])
        self.seeds = [int(seed) for seed in saved["seeds"]]
        for rng, state in zip(self.rngs, saved["generators"], strict=True):
            set_random_state(rng, state)
        self._recall(self.env_rows(None))
        self._expect_plants(range(self.num_envs))

    def _recall(self, env_idx: Tensor) -> None:
        self.plant_batch.place(env_idx, self.state.plant_pose[env_idx])
        self._look_up_targets()
        self.place_arms()
        self.game.recall(env_idx)


def check_action(action: Any, num_envs: int, size: int, device: torch.device) -> Tensor:
    """Actions of shape (num_envs, size), or (size,) for one environment, as a float32 tensor of the former.

    Raises:
        InvalidInputError: They are something else, or not finite.
    """
    batch = action_batch(action, num_envs, size, device)
    check_finite(batch)
    return batch


def check_finite(batch: Tensor) -> None:
    """Checks that actions are finite, which waits for the device.

    Raises:
        InvalidInputError: One is not.
    """
    if not bool(batch.isfinite().all()):
        raise InvalidInputError("an action must be finite; got NaN or infinity")


def action_batch(action: Any, num_envs: int, size: int, device: torch.device) -> Tensor:
    """Actions as of `check_action`, which may yet hold NaN or infinity.

    Raises:
        InvalidInputError: They are something else.
    """
    if isinstance(action, Mapping):
        raise InvalidInputError(
            "an action is an array; choose its meaning with control_mode in gymnasium.make"
        )
    try:
        batch = torch.as_tensor(action, dtype=torch.float32, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidInputError(
            f"an action must be an array of numbers; got {type(action).__name__}"
        ) from error
    if batch.shape == (size,) and num_envs == 1:
        batch = batch[None]
    if batch.shape != (num_envs, size):
        single = f" or ({size},)" if num_envs == 1 else ""
        raise InvalidInputError(
            f"an action must have shape ({num_envs}, {size}){single}; got {tuple(batch.shape)}"
        )
    return batch
