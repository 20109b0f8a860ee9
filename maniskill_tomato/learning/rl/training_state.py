"""Everything that changes while a run goes on, and how a checkpoint keeps it."""

import random
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.learning.rl.agent import make_agent
from maniskill_tomato.learning.rl.checkpoint import TRAINING_PARTS
from maniskill_tomato.learning.rl.demonstrated_reward import RewardModel
from maniskill_tomato.learning.rl.env_state import (
    env_state,
    set_env_state,
    set_tensor_attributes,
    tensor_attributes,
)
from maniskill_tomato.learning.rl.envs import LearnerEnv
from maniskill_tomato.learning.rl.experience import Experience, make_replay
from maniskill_tomato.learning.rl.exploration import make_exploration
from maniskill_tomato.learning.rl.history import TrainingHistory
from maniskill_tomato.learning.rl.observations import device_of, mapped
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.learning.rl.run_folder import RUN_STATE_FORMAT
from maniskill_tomato.sensing.image_observation import PRIVILEGED, Observation
from maniskill_tomato.tasks.numpy_streams import numpy_state, random_state


class TrainingState:
    """The agent, its memory, its environments and its counters at one moment of a run."""

    def __init__(
        self,
        env: LearnerEnv,
        config: TrainConfig,
        dims: tuple[int, int],
        seed: int,
        observations: Observation,
        info: dict[str, Any],
        run_dir: Path | None = None,
        reward_model: RewardModel | None = None,
    ) -> None:
        """The state at the start of a run.

        Args:
            env: The environments, just reset.
            config: How to learn.
            dims: Number of observed values, those of images left out, and of actions.
            seed: Seed of the replay, the exploration and the target noise.
            observations: What the reset gave. Shape (num_envs, observation_dim), or with images.
            info: What it gave beside them.
            run_dir: Folder of the run, for a replay buffer on the disk.
            reward_model: Judges in place of the task.
        """
        device = device_of(observations)
        privileged = (
            0 if isinstance(observations, Tensor) else observations.get(PRIVILEGED, Tensor()).shape[-1]
        )
        self.env = env
        self.reward_model = reward_model
        if reward_model is not None:
            reward_model.to(device)
        self.agent = make_agent(config, *dims, device, privileged_dim=privileged)
        self.replay = make_replay(config, env.single_observation_space, dims[1], device, run_dir)
        self.experience = Experience(config, self.replay, dims[0])
        self.experience.begin(info)
        self.generator = torch.Generator(device=device).manual_seed(seed)
        self.exploration = make_exploration(config, self.generator, device)
        self.history = TrainingHistory(env.num_envs)
        self.observations = observations
        self.visible_fraction: Tensor = info["visible_fraction"]
        """V_f of the present views. Shape (num_envs,)."""
        self.episode_starts = torch.ones(env.num_envs, dtype=torch.bool, device=device)
        self.step = 0
        """Environment steps, counted over all environments."""
        self.updates = 0
        self.updates_owed = 0.0
        """Part of an update that the steps so far add up to."""
        self.episodes = 0

    def run_state(self, log_state: dict[str, Any]) -> dict[str, Any]:
        """What a run needs beside its networks and counters to go on exactly: data only, on the CPU."""
        return {
            "format": RUN_STATE_FORMAT,
            "torch_version": str(torch.__version__),
            "updates_owed": self.updates_owed,
            "replay": self.replay.state_dict(),
            "experience": self.experience.state_dict(),
            "reward_model": None if self.reward_model is None else self.reward_model.state_dict(),
            "exploration": tensor_attributes(self.exploration),
            "history": self.history.state_dict(),
            "log": log_state,
            "observations": mapped(self.observations, Tensor.cpu),
            "visible_fraction": self.visible_fraction.cpu(),
            "episode_starts": self.episode_starts.cpu(),
            "generator": self.generator.get_state().cpu(),
            "env": env_state(self.env),
            "random": global_random_state(),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Puts everything back to the moment of the checkpoint `saved`.

        Raises:
            CheckpointError: It is of another run.
        """
        run, counters, device = saved["run"], saved["counters"], device_of(self.observations)
        try:
            eye = ("encoder",) if self.agent.encoder is not None else ()
            for name in ("actor", "normalizer", *eye, *TRAINING_PARTS):
                getattr(self.agent, name).load_state_dict(saved[name])
            self.replay.load_state_dict(run["replay"])
            self.experience.load_state_dict(run["experience"])
            if self.reward_model is not None:
                self.reward_model.load_state_dict(run["reward_model"])
            set_tensor_attributes(self.exploration, run["exploration"], device)
            self.history.load_state_dict(run["history"])
            self.observations = mapped(run["observations"], lambda values: values.to(device))
            self.visible_fraction = run["visible_fraction"].to(device)
            self.episode_starts = run["episode_starts"].to(device)
            self.step = counters["steps"]
            self.episodes, self.updates = counters["episodes"], counters["updates"]
            self.updates_owed = run["updates_owed"]
            set_env_state(self.env, run["env"])
            self.generator.set_state(run["generator"])
            set_global_random_state(run["random"])
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise CheckpointError(
                f"the checkpoint of step {counters['steps']} does not fit this run: {error!r}; "
                "train again with --overwrite"
            ) from error


def seed_global_random_state(seed: int) -> None:
    """Seeds Python's, NumPy's and torch's global generators."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def global_random_state() -> dict[str, Any]:
    """The states of Python's, NumPy's and torch's global generators, CUDA's included."""
    version, numbers, gauss = random.getstate()
    legacy: Any = np.random.mtrand._rand
    return {
        "python": {"version": version, "numbers": torch.tensor(numbers), "gauss": gauss},
        "numpy": random_state(legacy),
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }


def set_global_random_state(state: dict[str, Any]) -> None:
    """Puts them back as `global_random_state` found them."""
    python = state["python"]
    random.setstate((python["version"], tuple(python["numbers"].tolist()), python["gauss"]))
    np.random.set_state(numpy_state(state["numpy"]))
    torch.set_rng_state(state["torch"].cpu())
    if state["cuda"] and torch.cuda.device_count() == len(state["cuda"]):
        torch.cuda.set_rng_state_all([s.cpu() for s in state["cuda"]])
