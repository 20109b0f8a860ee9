"""The twin's plant and start: an episode of one of the simulated task's lists, number for number."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.deploy.collision import CollisionChecker
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.move_choice import Postures
from maniskill_tomato.plants.episode_list import Episode, load_episodes
from maniskill_tomato.plants.mesh_set import ALL
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.plants.spec import ROW_PLANT, PlantSpec
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import LookAtMover

START_MARGIN: Final = 0.05
"""How far the start's joints stay from their limits where they can, in [rad]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TwinEpisode:
    """A plant, the fruit to look for, and where the arm begins."""

    plant: Plant
    T_world_plant: Tensor
    """Shape (4, 4), float32."""
    target: int
    """Index in `Plant.fruits`."""
    target_position: Tensor
    """Centre of the target, world frame, in [m]. Shape (3,), float32."""
    start_joints: Float64
    """Joint positions of the first view, in [rad]. Shape (7,)."""


@lru_cache(maxsize=4)
def load_episode(name: str, index: int, plants: str | None = None, model: ArmModel = IIWA14) -> TwinEpisode:
    """The episode that `TomatoViewpoint-v1` with `episodes=name` begins at `reset(seed=index)`.

    Args:
        name: One of the fixed lists, or a `.json` file of one.
        index: Which, modulo the list's length.
        plants: Mesh file or folder whose plants the list names; None for our own.
        model: Of the arm.

    Raises:
        ProfileError: The index is negative.
        InvalidInputError: There is no such list, or no such plant.
    """
    if index < 0:
        raise ProfileError(f"the seed must be 0 or more, got {index}")
    episodes = load_episodes(name)
    spec = ROW_PLANT if plants is None else PlantSpec.parse({"mesh": plants, "seed": ALL}, ROW_PLANT)
    return make_episode(episodes[index % len(episodes)], spec, model)


def make_episode(episode: Episode, spec: PlantSpec = ROW_PLANT, model: ArmModel = IIWA14) -> TwinEpisode:
    """Grows the plant and works out the start.

    Args:
        episode: Which plant, target and start.
        spec: The kind of plant that the episode's seed is of.
        model: Of the arm.

    Raises:
        ProfileError: The arm cannot look at the target from the episode's start.
    """
    plant = spec.grow(episode.plant_seed)
    T_world_plant = _plant_pose(episode.plant_pose)
    centre = torch.as_tensor(np.asarray(plant.fruits[episode.target].centre, dtype=np.float32))
    # Single precision and in this order, as in the simulated task, so that both start from the same bits.
    target_position = (T_world_plant[:3, :3] @ centre[:, None])[:, 0] + T_world_plant[:3, 3]
    looked_at = (centre[None] @ T_world_plant[:3, :3].T + T_world_plant[:3, 3]).double()
    ready = torch.tensor(model.ready_qpos, dtype=torch.float64)[None]
    position = torch.tensor([episode.camera_position], dtype=torch.float64)
    look = LookAtMover(model=model).look_from(ready, position, looked_at, largest_joint_step=10.0)
    if int(look.reach[0]) != Reach.REACHABLE:
        raise ProfileError(
            f"the {model.name} cannot look at the target from {episode.camera_position} [m], where the episode "
            "begins; choose another --seed"
        )
    start = look.qpos[0].float().double().numpy()
    return TwinEpisode(
        plant=plant,
        T_world_plant=T_world_plant,
        target=episode.target,
        target_position=target_position,
        start_joints=_clear_start(start, position[0].numpy(), looked_at[0].numpy(), model),
    )


def _clear_start(start: Float64, position: Float64, target: Float64, model: ArmModel) -> Float64:
    """The task's start posture, or if that touches the table or itself, the nearest other one that does not.

    The task moves joints without collisions; an operator would not leave a real arm there.
    """
    checker = CollisionChecker(model=model)
    low, high = model.joint_lower + START_MARGIN, model.joint_upper - START_MARGIN
    inside = (start > low).all() and (start < high).all()
    if inside and checker.nearest(start[None]) is None:
        return start
    postures = Postures(T_flange_camera_color_optical, START_MARGIN, model)
    for posture in postures.at(position, target, start):
        if checker.nearest(posture[None]) is None:
            return posture
    return start


def _plant_pose(pose: tuple[float, float, float]) -> Tensor:
    x, y, yaw = torch.as_tensor(np.array(pose), dtype=torch.float32)
    c, s = yaw.cos(), yaw.sin()
    T = torch.eye(4)
    T[0, 0], T[0, 1], T[1, 0], T[1, 1] = c, -s, s, c
    T[:3, 3] = torch.stack([x, y, torch.zeros_like(x)])
    return T
