"""An episode that is stepped move by move, with a snapshot of every view; it knows nothing of any page."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.imitation.demonstrations import copied_arrays
from maniskill_tomato.plants.organs import Plant, with_fruit_at
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.lattice_planner import LatticePlanner
from maniskill_tomato.policies.opening import RANDOM, open_policy, shipped_policy
from maniskill_tomato.policies.protocol import Policy, reseed
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.occlusion_memory import CELL_SIZE, OcclusionMemory
from maniskill_tomato.tasks.vector_env import make_vector_env
from maniskill_tomato.view.demonstrating import POLICY_MOVED, TARGET_MOVED, PersonsDemonstrations
from maniskill_tomato.view.episode_recording import (
    Candidates,
    EpisodeRecording,
    Float64,
    Foliage,
    HandView,
    MappedFruit,
    MeasuredFraction,
    Snapshot,
    Voxel,
)
from maniskill_tomato.view.hand_move import hand_move
from maniskill_tomato.view.play_settings import SHIPPED, PlaySettings
from maniskill_tomato.view.player import NO_DRAG
from maniskill_tomato.view.world_camera import WorldCamera, as_double

OVER: Final = "the episode is over; *Reset* begins it again, and another seed begins another one"
"""Why no move is made."""

STANDS_STILL: Final = 1e-4
"""A camera that moved less has not moved, in [m]."""


class PlaySession:
    """One environment without a simulator, its policy, and the recording of its episode.

    The policy decides as soon as a view is there, so that the snapshot holds what it is about to do. Moves and
    decisions are those that an evaluation of the same seed makes.
    """

    def __init__(self, settings: PlaySettings, demonstrations: PersonsDemonstrations | None = None) -> None:
        """Opens the task and the policy and begins the episode.

        Args:
            settings: Which.
            demonstrations: Keeps what a person shows; None where nothing is kept.

        Raises:
            InvalidInputError: An option cannot be used, or the demonstrations are of something else.
            PolicyError: The policy cannot be used.
        """
        if demonstrations is not None:
            demonstrations.check(settings)
        self.settings = settings
        self._demonstrations = demonstrations
        self._env = make_vector_env(
            settings.env_id, arrays="torch", autoreset_mode="Disabled", **settings.world_options()
        )
        self._world = self._env.world
        self._camera = WorldCamera(self._world)
        self._action: Tensor | None = None
        self._own_plant: Plant | None = None
        self.recording: EpisodeRecording
        """The episode so far."""
        self.begin(settings.seed)

    def begin(self, seed: int) -> None:
        """Begins the episode of a seed, which is the same whatever came before.

        Raises:
            PolicyError: The policy cannot be used.
        """
        self._put_back()
        self._policy = self._open_policy(seed)
        self._acting = as_state_policy(self._policy, self._env)
        observations, info = self._env.reset(seed=seed)
        if self._demonstrations is not None:
            self._demonstrations.begin(seed, self._world.control_mode, copied_arrays(observations))
        world, settings = self._world, self.settings
        seen = "" if settings.perception == "ground_truth" else f", {settings.perception}"
        self.recording = EpisodeRecording(
            title=f"{settings.env_id}, seed {seed}, {self._policy.name}{seen}",
            plant=world.plant_batch.plants[0],
            T_w_plant=as_double(world.plant_batch.T_world_plant[0]),
            threshold=float(world.task.full_visibility),
            fov_y=float(world.intrinsics.fov_y),
        )
        self._decide(observations)
        self.recording.snapshots.append(self._snapshot(info, ""))

    @property
    def is_over(self) -> bool:
        """Whether the episode has ended."""
        return self._action is None

    def step(self) -> bool:
        """Makes the move that the policy has decided on.

        Returns:
            Whether there was one to make.
        """
        if self._action is None:
            return False
        if self._demonstrations is not None:
            self._demonstrations.object(POLICY_MOVED)
        self._make(self._action)
        return True

    def move_camera(self, position: Float64) -> None:
        """Makes a move of a person in place of the policy's: to a place, or a part of the way there.

        Args:
            position: Of the camera, in the world frame, in [m]. Shape (3,).

        Raises:
            InvalidInputError: The episode is over, or no move of the arm leads there.
            NotWrittenError: A demonstration that the move completes cannot be saved.
        """
        if self._action is None:
            raise InvalidInputError(OVER)
        self._make(hand_move(self._world, position))

    @property
    def demonstrated(self) -> str | None:
        """What becomes of the episode as a demonstration, in words; None where nothing is kept."""
        return None if self._demonstrations is None else self._demonstrations.in_words

    @property
    def _hides_policy(self) -> bool:
        """Whether a person shows what to do, whom the policy's choice would lead."""
        return self._demonstrations is not None

    def _make(self, action: Tensor) -> None:
        """Makes a move and lets the policy decide on the new view."""
        before = self._world.T_w_camera[0, :3, 3].clone()
        result = self._env.step(action)
        observations, _, terminated, truncated, info = result
        event = move_in_words(info, float((self._world.T_w_camera[0, :3, 3] - before).norm()))
        if bool(terminated[0]) or bool(truncated[0]):
            self._action = None
            self.recording.outcome = _outcome(info, self.recording.moves + 1)
        else:
            self._decide(observations)
        self.recording.snapshots.append(self._snapshot(info, event))
        if self._demonstrations is not None:
            self._demonstrations.add(copied_arrays(action), copied_arrays(result))

    def move_target(self, position: Float64) -> None:
        """Hangs the target elsewhere: the last view is seen again as it is now, and the episode goes on from there.

        The policy decides anew with `decide_again`. Another episode has its own plant again.

        Args:
            position: Of its centre, in the world frame, in [m]. Shape (3,).

        Raises:
            InvalidInputError: A camera says which fruit the target is.
        """
        if self.target_place() is None:
            raise InvalidInputError(NO_DRAG)
        if self._demonstrations is not None:
            self._demonstrations.object(TARGET_MOVED)
        world = self._world
        plant = world.plant_batch.plants[0]
        if self._own_plant is None:
            self._own_plant = plant
        T = as_double(world.plant_batch.T_world_plant[0])
        centre = (np.asarray(position) - T[:3, 3]) @ T[:3, :3]
        moved = with_fruit_at(plant, int(world.state.target[0]), centre.astype(np.float32))
        world.exchange_plants({0: moved})
        self.recording.plant = moved
        self.recording.snapshots[-1] = self._seen_again()

    def decide_again(self) -> None:
        """Lets the policy decide on the last view as it is now, unless the episode has ended."""
        if self._action is not None:
            self._decide(self._world.observation())
        self.recording.snapshots[-1] = self._seen_again()

    def target_place(self) -> Float64 | None:
        """Where the target is, in the world frame, in [m]; None where a camera says which it is. Shape (3,)."""
        if self.settings.perception != "ground_truth":
            return None
        return as_double(self._world.target_position_w[0])

    def _seen_again(self) -> Snapshot:
        """The last view on a plant that was altered."""
        world, last = self._world, self.recording.snapshots[-1]
        truth = world.ground_truth.visible_fraction(world.T_w_camera, qpos=world.state.qpos)
        info = {**world.info(), "visible_fraction": truth}
        return replace(self._snapshot(info, last.event), was_refused=last.was_refused)

    def _put_back(self) -> None:
        """Shows the plant as it grew."""
        if self._own_plant is not None:
            self._world.exchange_plants({0: self._own_plant})
            self._own_plant = None

    def _open_policy(self, seed: int) -> Policy:
        settings = self.settings
        source = shipped_policy(settings.env_id) if settings.policy == SHIPPED else settings.policy
        policy = open_policy(
            source,
            env_id=settings.env_id,
            ground_truth=self._world.ground_truth,
            seed=seed if source == RANDOM else 0,
        )
        reseed(policy, seed)
        return policy

    def _decide(self, observations: Tensor) -> None:
        self._action = self._acting.act(observations)

    def _snapshot(self, info: dict[str, Any], event: str) -> Snapshot:
        world = self._world
        belief = world.belief if world.keeps_belief else None
        true = info.get("true_visible_fraction")
        perception: CameraPerception | None = getattr(world.game, "perception", None)
        moved = "reachability" in info and bool(event)
        return Snapshot(
            joint_positions=as_double(world.state.qpos[0]),
            T_w_camera=as_double(world.T_w_camera[0]),
            target_position=as_double(world.game.known_target()[0]),
            visible_fraction=float(info["visible_fraction"][0]),
            true_visible_fraction=None if true is None else float(true[0]),
            measured=None if perception is None else _measured(perception),
            rays=self._camera.target_rays(),
            picture=self._camera.picture(world.T_w_camera[0], world.T_w_links[0]),
            target_organ=int(world.plant_batch.fruit_organ(world.state.target)[0]),
            event=event,
            was_refused=moved and int(info["reachability"][0]) == int(Reach.UNREACHABLE),
            candidates=self._candidates(),
            T_w_camera_next=self._next_camera(),
            foliage=None if belief is None else _foliage(belief.memory),
            fruits=() if perception is None else _fruits(perception),
        )

    def look_from(self, position: Float64) -> HandView:
        """What a camera elsewhere would see of the present target.

        Args:
            position: Of the camera, in the world frame, in [m]. Shape (3,).
        """
        return self._camera.look_from(position, self._world.game.known_target()[0])

    def _candidates(self) -> Candidates | None:
        policy = self._policy
        if (
            self._hides_policy
            or self._action is None
            or not isinstance(policy, LatticePlanner)
            or policy.judged is None
        ):
            return None
        judged = policy.judged
        return Candidates(
            positions=judged.positions[0].float().cpu().numpy(),
            worth=judged.worth[0].float().cpu().numpy(),
            chosen=int(judged.chosen[0]),
        )

    def _next_camera(self) -> Float64 | None:
        """Where the decided move takes the camera, by kinematics alone."""
        if self._hides_policy or self._action is None:
            return None
        world, state = self._world, self._world.state
        plan = world.moves.plan(
            state.qpos, state.viewpoint, world.game.known_target(), world.check_action(self._action)
        )
        return as_double(world.camera_poses(link_transforms(plan.target_qpos))[0])


def move_in_words(info: dict[str, Any], way_m: float) -> str:
    """What came of a move, in words.

    Args:
        info: Of the step, one environment.
        way_m: How far the camera went, in [m].
    """
    reach = int(info["reachability"][0])
    moved = f"{100.0 * way_m:.0f} cm"
    if int(info.get("transits", [0])[0]):
        words = [f"went by its ready posture to a place {moved} away"]
    elif reach == int(Reach.UNREACHABLE):
        words = ["refused: the arm does not reach the pose, nor one nearby"]
        words += ["it went home"] if way_m > STANDS_STILL else []
    elif reach == int(Reach.NEIGHBOUR):
        words = [f"moved {moved} to a pose nearby, as the arm does not reach the one asked for"]
    else:
        words = [f"moved {moved}"]
    if "plant_contact" in info and bool(info["plant_contact"][0]):
        words.append("touched the plant")
    if "in_forbidden_zone" in info and bool(info["in_forbidden_zone"][0]):
        words.append("stood in the forbidden zone")
    if "target_done" in info and bool(info["target_done"][0]):
        words.append("saw its target")
    return "; ".join(words)


def _outcome(info: dict[str, Any], moves: int) -> str:
    """How an episode ended."""
    after = "1 move" if moves == 1 else f"{moves} moves"
    if "seen_count" in info:
        return f"{int(info['seen_count'][0])} of {int(info['target_count'][0])} tomatoes seen after {after}"
    return f"{'fully visible' if bool(info['success'][0]) else 'not fully visible'} after {after}"


def _foliage(memory: OcclusionMemory) -> Foliage:
    known = memory.known[0].cpu().numpy()
    passes = torch.exp(-memory.density[0] * CELL_SIZE).cpu().numpy()
    voxels = np.where(known, np.where(passes < 0.5, int(Voxel.BLOCKED), int(Voxel.FREE)), int(Voxel.UNKNOWN))
    return Foliage(
        centre=as_double(memory.target_position[0]), cell_size=CELL_SIZE, voxels=voxels.astype(np.uint8)
    )


def _measured(perception: CameraPerception) -> MeasuredFraction:
    return MeasuredFraction(
        value=float(perception.visible_fraction[0]),
        margin=float(perception.fraction_margin[0]),
    )


def _fruits(perception: CameraPerception) -> tuple[MappedFruit, ...]:
    target, fruits, view = perception.target(0), perception.map(0), perception.last_view(0)

    def fraction(number: int) -> MeasuredFraction | None:
        index = None if view is None else view.detection(number)
        if view is None or index is None:
            return None
        seen = fruits.fraction(view.measurement, index, number)
        return MeasuredFraction(value=seen.value, margin=fruits.config.stop_errors * seen.error)

    return tuple(
        MappedFruit(
            number=track.number,
            position=track.position_w.copy(),
            radius=track.radius_m,
            spread=float(np.sqrt(np.linalg.eigvalsh(track.covariance[:3, :3])[-1])),
            is_ripe=track.is_ripe,
            is_target=track is target,
            fraction=fraction(track.number),
        )
        for track in fruits.tracks.values()
        if track.existence > 0.5
    )
