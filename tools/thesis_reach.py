"""How often the sparse task's untrained actors leave the workspace with their first action, by reading of the thesis.

Up to episode 238 its sparse episodes take 7.6 steps each, though leaving the workspace ends an episode (5-2-1). So at
most about an eighth of its steps can have left it. The actor is that of Table 5-2, started at the task's own starts in
the scene of the thesis; what is read differently is what the inverse kinematics takes instead of a pose that the arm
cannot reach, or how large the actor's outputs are.

Usage:
    python tools/thesis_reach.py
"""

import math
import sys
from dataclasses import dataclass, replace

import torch
import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.learning.rl.agent import make_actor, make_normalizer
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.robot.inverse_kinematics import IkConfig, InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import viewpoint_transform
from maniskill_tomato.tasks import THESIS_IDS
from maniskill_tomato.tasks.making import make_world
from maniskill_tomato.tasks.world import World

NEIGHBOURS = (
    (0.05, 10.0),
    (0.1, 20.0),
    (0.2, 30.0),
    (0.3, 60.0),
    (0.5, 85.0),
    (0.01, 85.0),
    (0.1, 85.0),
    (0.3, 85.0),
)
"""How far a pose that is taken instead may be, in [m] and [deg]; 85 degrees let the camera look almost anywhere."""

ACTION_SCALES = (0.35, 0.2, 0.1, 0.05)
"""What an output of 1 stands for, in [m] and [rad]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    actors: int = 200
    """Freshly initialised actors, each at a start of its own."""


def first_actions(world: World, config: TrainConfig) -> torch.Tensor:
    """What the actors ask for first. Shape (N, 6)."""
    observations = world.observation()
    actions = []
    for i, observation in enumerate(observations):
        torch.manual_seed(i)
        actor = make_actor(config, len(observation), len(config.action_scale))
        with torch.no_grad():
            actions.append(actor(make_normalizer(config, len(observation))(observation[None])))
    return torch.cat(actions) * torch.tensor(config.action_scale)


def refused(world: World, actions: torch.Tensor, neighbour: IkConfig | None) -> tuple[float, float]:
    """Shares of the poses asked for that the arm refuses, and of those for which it takes a neighbour."""
    state = world.state
    kinematics = InverseKinematics(config=neighbour)
    poses = viewpoint_transform(state.viewpoint + actions)
    reach = kinematics.solve(poses, state.qpos, neighbour=neighbour is not None).reach
    out, near = (float((reach == int(kind)).float().mean()) for kind in (Reach.UNREACHABLE, Reach.NEIGHBOUR))
    return out, near


def main(args: Args) -> None:
    """Prints a row for each reading."""
    torch.set_num_threads(1)
    exact = get_preset("thesis-sparse")
    world = make_world(THESIS_IDS[1], args.actors, scene="thesis")
    world.reset(list(range(args.actors)))
    print("| reading | refused | a neighbour taken |")
    print("|---|---|---|")

    def tell(name: str, config: TrainConfig, neighbour: IkConfig | None) -> None:
        out, near = refused(world, first_actions(world, config), neighbour)
        print(f"| {name} | {100 * out:.0f} % | {100 * near:.0f} % |", flush=True)

    tell("no pose instead", exact, None)
    for distance, angle in NEIGHBOURS:
        near = IkConfig(neighbour_distance=distance, neighbour_angle=math.radians(angle))
        tell(f"a pose within {100 * distance:g} cm and {angle:g} degrees instead", exact, near)
    tell("output weights within 0.003, no pose instead", replace(exact, actor_output_init="small"), None)
    for scale in ACTION_SCALES:
        tell(
            f"outputs of 1 are {scale:g} m and rad, no pose instead",
            replace(exact, action_scale=(scale,) * 6),
            None,
        )
    small = replace(exact, action_scale=(0.1,) * 6)
    tell("outputs of 1 are 0.1 m and rad, a pose within 5 cm and 10 degrees instead", small, IkConfig())


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except TomatoError as error:
        sys.exit(f"error: {error}")
