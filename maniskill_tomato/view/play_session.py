"""An episode that is stepped move by move, with a snapshot of every view; it knows nothing of any page."""

from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.lattice_planner import LatticePlanner
from maniskill_tomato.policies.opening import RANDOM, open_policy, shipped_policy
from maniskill_tomato.policies.protocol import Policy, reseed
from maniskill_tomato.policies.reach import CameraReach
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.occlusion_memory import CELL_SIZE, OcclusionMemory
from maniskill_tomato.tasks.vector_env import make_vector_env
from maniskill_tomato.view.episode_recording import (
    Candidates,
    EpisodeRecording,
    Float64,
    Foliage,
    HandView,
    MappedFruit,
    Snapshot,
    UInt8,
    Voxel,
)
from maniskill_tomato.view.plant_meshes import organ_colours
from maniskill_tomato.view.play_settings import SHIPPED, PlaySettings

PICTURE_SIZE: Final = (320, 240)
"""Width and height of the wrist camera's picture as it is shown, in [px]."""

SKY: Final = (178.0, 196.0, 204.0)
"""Colour of what stands behind the row, sRGB."""

ARM: Final = (206.0, 206.0, 208.0)
"""Colour of the arm in the picture, sRGB."""

STANDS_STILL: Final = 1e-4
"""A camera that moved less has not moved, in [m]."""


class PlaySession:
    """One environment without a simulator, its policy, and the recording of its episode.

    The policy decides as soon as a view is there, so that the snapshot holds what it is about to do. Moves and
    decisions are those that an evaluation of the same seed makes.
    """

    def __init__(self, settings: PlaySettings) -> None:
        """Opens the task and the policy and begins the episode.

        Raises:
            InvalidInputError: An option cannot be used.
            PolicyError: The policy cannot be used.
        """
        self.settings = settings
        self._env = make_vector_env(settings.env_id, auto_reset=False, **settings.world_options())
        self._world = self._env.world
        self._palette: tuple[Any, Float64] | None = None
        self._action: Tensor | None = None
        self._reach: CameraReach | None = None
        self.recording: EpisodeRecording
        """The episode so far."""
        self.begin(settings.seed)

    def begin(self, seed: int) -> None:
        """Begins the episode of a seed, which is the same whatever came before.

        Raises:
            PolicyError: The policy cannot be used.
        """
        self._policy = self._open_policy(seed)
        self._acting = as_state_policy(self._policy, self._env)
        observations, info = self._env.reset(seed=seed)
        world, settings = self._world, self.settings
        seen = "" if settings.perception == "ground_truth" else f", {settings.perception}"
        self.recording = EpisodeRecording(
            title=f"{settings.env_id}, seed {seed}, {self._policy.name}{seen}",
            plant=world.plant_batch.plants[0],
            T_w_plant=_double(world.plant_batch.T_world_plant[0]),
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
        before = self._world.T_w_camera[0, :3, 3].clone()
        observations, _, terminated, truncated, info = self._env.step(self._action)
        event = _event(info, float((self._world.T_w_camera[0, :3, 3] - before).norm()))
        if bool(terminated[0]) or bool(truncated[0]):
            self._action = None
            self.recording.outcome = _outcome(info, self.recording.moves + 1)
        else:
            self._decide(observations)
        self.recording.snapshots.append(self._snapshot(info, event))
        return True

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
            joint_positions=_double(world.state.qpos[0]),
            T_w_camera=_double(world.T_w_camera[0]),
            target_position=_double(world.game.known_target()[0]),
            visible_fraction=float(info["visible_fraction"][0]),
            true_visible_fraction=None if true is None else float(true[0]),
            picture=self._picture(world.T_w_camera[0], world.T_w_links[0]),
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
        world = self._world
        target = world.game.known_target()[0].double()
        place = torch.as_tensor(position, dtype=torch.float64)[None]
        T = look_at_pose(place, target[None])
        if self._reach is None:
            self._reach = CameraReach(world.device)
        return HandView(
            T_w_camera=_double(T[0]),
            visible_fraction=float(world.ground_truth.visible_fraction(T)[0]),
            is_reachable=bool(self._reach.reachable(place, target)[0]),
            picture=self._picture(T[0].float(), None),
        )

    def _picture(self, T_w_camera: Tensor, T_w_links: Tensor | None) -> UInt8:
        """What a camera sees, each organ in its mean colour. Shape (H, W, 3)."""
        world = self._world
        plant = world.plant_batch.plants[0]
        if self._palette is None or self._palette[0] is not plant:
            self._palette = plant, np.concatenate([[SKY, ARM], organ_colours(plant)])
        picture = world.scene.picture(
            world.intrinsics.scaled(*PICTURE_SIZE),
            T_w_camera,
            world.plant_batch.T_world_plant[0],
            T_w_links,
        )
        return picture.coloured(self._palette[1])

    def _candidates(self) -> Candidates | None:
        policy = self._policy
        if self._action is None or not isinstance(policy, LatticePlanner) or policy.judged is None:
            return None
        judged = policy.judged
        return Candidates(
            positions=judged.positions[0].float().cpu().numpy(),
            worth=judged.worth[0].float().cpu().numpy(),
            chosen=int(judged.chosen[0]),
        )

    def _next_camera(self) -> Float64 | None:
        """Where the decided move takes the camera, by kinematics alone."""
        if self._action is None:
            return None
        world, state = self._world, self._world.state
        plan = world.moves.plan(
            state.qpos, state.viewpoint, world.game.known_target(), world.check_action(self._action)
        )
        return _double(world.camera_poses(link_transforms(plan.target_qpos))[0])


def _event(info: dict[str, Any], way_m: float) -> str:
    """What came of a move, in words."""
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
        centre=_double(memory.target_position[0]), cell_size=CELL_SIZE, voxels=voxels.astype(np.uint8)
    )


def _fruits(perception: CameraPerception) -> tuple[MappedFruit, ...]:
    target = perception.target(0)
    return tuple(
        MappedFruit(
            number=track.number,
            position=track.position_w.copy(),
            radius=track.radius_m,
            spread=float(np.sqrt(np.linalg.eigvalsh(track.covariance[:3, :3])[-1])),
            is_ripe=track.is_ripe,
            is_target=track is target,
        )
        for track in perception.map(0).tracks.values()
        if track.existence > 0.5
    )


def _double(values: Tensor) -> Float64:
    """A copy in double precision."""
    return np.array(values.detach().double().cpu().numpy())
