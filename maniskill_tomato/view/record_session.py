"""Stored episodes of `eval` and `benchmark`, seen again: each policy's way through the same episode."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.episode_listing import ListedEpisode, failures_first, list_episode
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.row_benchmark import CAMERA_OPTIONS
from maniskill_tomato.experiments.stored_episodes import StoredEpisodes, read_stored_episodes
from maniskill_tomato.plants.plant_generators import check_recorded_plant
from maniskill_tomato.report_design import SERIES, rgb
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.task_registry import check_recorded_task, find_task
from maniskill_tomato.tasks.making import option_names
from maniskill_tomato.tasks.vector_env import make_vector_env
from maniskill_tomato.view.episode_recording import (
    EpisodeRecording,
    Float64,
    HandView,
    PolicyWay,
    Snapshot,
    UInt8,
)
from maniskill_tomato.view.play_session import move_in_words
from maniskill_tomato.view.play_settings import PlaySettings
from maniskill_tomato.view.world_camera import WorldCamera, as_double

SAME_PLANT: Final = 0.05
"""V_f of a first view may differ so much from the stored one: of rounding, and of another count of rays."""


class RecordSession:
    """Shows one stored episode after another.

    The plant is grown again from the episode's seed, and the arm stands where it stood; nothing is decided again. Only
    what policies thought at the time is not there: candidates and the occlusion memory.
    """

    is_over = True

    def __init__(self, folder: Path) -> None:
        """Reads the episodes of an experiment and shows the first failure.

        Args:
            folder: Of a `benchmark` or an `eval`.

        Raises:
            InvalidInputError: There are none, or they cannot be shown.
        """
        self.settings = PlaySettings()
        self._folder = folder
        self.conditions: Mapping[str, StoredEpisodes] = {c.name: c for c in read_stored_episodes(folder)}
        """What was measured, by the names of the conditions."""
        self._made: tuple[str, Any, WorldCamera] | None = None
        self.recording: EpisodeRecording
        """The episode of the chosen policy, with the ways of the others."""
        self.condition = next(iter(self.conditions))
        """The chosen condition."""
        self.policy = next((p for p in self.policies if self.failures(p)), self.policies[0])
        """The chosen policy."""
        self.seed = self.listed(self.policy)[0].seed
        """Seed of the chosen episode."""
        self.choose()

    @property
    def policies(self) -> Sequence[str]:
        """Those that ran under the chosen condition."""
        return list(self.conditions[self.condition].episodes)

    def listed(self, policy: str) -> list[ListedEpisode]:
        """The episodes of a policy under the chosen condition, failures first."""
        stored = self.conditions[self.condition]
        threshold, horizon = self._limits(stored)
        return failures_first(
            list_episode(record, threshold, horizon, None) for record in stored.episodes[policy].values()
        )

    def failures(self, policy: str) -> list[int]:
        """Seeds of the episodes that a policy failed under the chosen condition, the worst first."""
        return [episode.seed for episode in self.listed(policy) if not episode.success]

    def choose(
        self, *, condition: str | None = None, policy: str | None = None, seed: int | None = None
    ) -> None:
        """Shows another episode.

        Args:
            condition: Another condition; its first policy that is chosen already, or the first one.
            policy: Another policy, in the same episode if it ran it.
            seed: Another episode.

        Raises:
            InvalidInputError: It is not there, or its plant cannot be grown again; the present one stays.
        """
        before = self.condition, self.policy, self.seed
        try:
            if condition is not None:
                self.condition = _known("the condition", condition, self.conditions)
                self.policy = self.policy if self.policy in self.policies else self.policies[0]
            if policy is not None:
                self.policy = _known("the policy", policy, self.policies)
            episodes = self.conditions[self.condition].episodes[self.policy]
            if seed is not None and seed not in episodes:
                raise InvalidInputError(
                    f"{self._folder} holds no episode {seed} of {self.policy}; it has {_numbers(list(episodes))}"
                )
            wanted = self.seed if seed is None else seed
            self.seed = wanted if wanted in episodes else self.listed(self.policy)[0].seed
            self.recording = self._recording()
        except InvalidInputError:
            self.condition, self.policy, self.seed = before
            raise

    def begin(self, seed: int) -> None:
        """Nothing: it has happened."""

    def step(self) -> bool:
        """There is never a move to make."""
        return False

    def look_from(self, position: Float64) -> HandView | None:
        """What a camera elsewhere would see of the episode's first target. Shape (3,), in [m]."""
        env, camera = self._env()
        return camera.look_from(position, env.world.target_position_w[0])

    def _recording(self) -> EpisodeRecording:
        """The chosen policy's recording, with those of all policies that ran the same episode."""
        stored = self.conditions[self.condition]
        env, camera = self._env()
        env.reset(seed=self.seed)
        world = env.world
        threshold, horizon = self._limits(stored)
        plant, T_w_plant = world.plant_batch.plants[0], as_double(world.plant_batch.T_world_plant[0])
        self._check_plant(world, stored)

        def retake(snapshot: Snapshot) -> UInt8:
            joints = torch.as_tensor(snapshot.joint_positions, dtype=torch.float32)[None]
            links = link_transforms(joints)
            return camera.picture(world.camera_poses(links)[0], links[0])

        ways = []
        for index, (label, episodes) in enumerate(stored.episodes.items()):
            if (record := episodes.get(self.seed)) is None:
                continue
            line = list_episode(record, threshold, horizon, None)
            ways.append(
                PolicyWay(
                    label=label,
                    colour=rgb(SERIES[index % len(SERIES)]),
                    is_solved=line.success,
                    recording=EpisodeRecording(
                        title=f"{self._folder.name}, {stored.name}, episode {self.seed}, {label}",
                        plant=plant,
                        T_w_plant=T_w_plant,
                        threshold=threshold,
                        fov_y=float(world.intrinsics.fov_y),
                        snapshots=_snapshots(record, world),
                        outcome=_outcome(line),
                        retake=retake,
                    ),
                )
            )
        chosen = next(way.recording for way in ways if way.label == self.policy)
        chosen.ways = tuple(ways)
        return chosen

    def _env(self) -> tuple[Any, WorldCamera]:
        """The environment of the chosen condition, which sees the truth."""
        stored = self.conditions[self.condition]
        if self._made is None or self._made[0] != self.condition:
            check_recorded_task(stored.env_id, self._folder)
            check_recorded_plant(stored.env_options.get("plant"), self._folder, "")
            known = option_names(stored.env_id) - set(CAMERA_OPTIONS)
            options = {name: value for name, value in stored.env_options.items() if name in known}
            env = make_vector_env(stored.env_id, arrays="torch", autoreset_mode="Disabled", **options)
            self._made = self.condition, env, WorldCamera(env.world)
        return self._made[1], self._made[2]

    def _limits(self, stored: StoredEpisodes) -> tuple[float, int | None]:
        """V_f above which the target is fully visible, and the most moves of an episode."""
        world = self._env()[0].world
        return float(world.task.full_visibility), find_task(stored.env_id).max_episode_steps

    def _check_plant(self, world: Any, stored: StoredEpisodes) -> None:
        """Compares V_f of a first view with the stored one.

        Raises:
            InvalidInputError: They differ: the plant is another one.
        """
        record = stored.episodes[self.policy][self.seed]
        if record.qpos is None:
            raise InvalidInputError(f"{self._folder} does not say where the arm stood; run it again")
        known = (
            record.visible_fraction if record.true_visible_fraction is None else record.true_visible_fraction
        )
        options = stored.env_options
        if options.get("sensor_noise") or options.get("target") == "any":
            return
        joints = torch.as_tensor(record.qpos[:1], dtype=torch.float32)
        pose = world.camera_poses(link_transforms(joints))
        found = float(world.ground_truth.visible_fraction(pose, qpos=joints)[0])
        if abs(found - known[0]) > SAME_PLANT:
            raise InvalidInputError(
                f"the plant of episode {self.seed} in {self._folder} is another one in this version (V_f of the first "
                f"view was {known[0]:.2f} and is {found:.2f}); run the episodes again"
            )


def _snapshots(record: EpisodeRecord, world: Any) -> list[Snapshot]:
    """The views of an episode, without pictures."""
    assert record.qpos is not None
    poses = as_double(world.camera_poses(link_transforms(torch.as_tensor(record.qpos, dtype=torch.float32))))
    snapshots = []
    for k in range(record.steps + 1):
        way_m = float(np.linalg.norm(poses[k, :3, 3] - poses[k - 1, :3, 3])) if k else 0.0
        true = record.true_visible_fraction
        snapshots.append(
            Snapshot(
                joint_positions=record.qpos[k],
                T_w_camera=poses[k],
                target_position=record.target[k],
                visible_fraction=float(record.visible_fraction[k]),
                true_visible_fraction=None if true is None else float(true[k]),
                event=move_in_words(_info(record, k - 1), way_m) if k else "",
                was_refused=bool(k) and int(record.reachability[k - 1]) == int(Reach.UNREACHABLE),
            )
        )
    return snapshots


def _info(record: EpisodeRecord, step: int) -> dict[str, Any]:
    """What is stored of a step, in the form of a task's info."""
    info: dict[str, Any] = {"reachability": [record.reachability[step]]}
    if record.contact is not None:
        info["plant_contact"] = [record.contact[step]]
    if record.in_forbidden_zone is not None:
        info["in_forbidden_zone"] = [record.in_forbidden_zone[step]]
    return info


def _outcome(line: ListedEpisode) -> str:
    after = "1 move" if line.moves == 1 else f"{line.moves} moves"
    return f"solved after {after}" if line.success else f"failed after {after}: {line.reason}"


def _known(what: str, name: str, names: Any) -> str:
    if name not in names:
        raise InvalidInputError.choice(what, name, list(names))
    return name


def _numbers(seeds: list[int]) -> str:
    """A few numbers in words."""
    if seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(str(seed) for seed in seeds[:20]) + (", ..." if len(seeds) > 20 else "")
