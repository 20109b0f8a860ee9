"""The reward learned from demonstrations, beside the designed one, behaviour cloning and constant rewards.

`designed` is the reward of the preset `td3`, whose settings all trainings share, but with one environment and an update
every second step. `cloned` fits its actor to the demonstrated moves. All others have the same demonstrated moves beside
their own in every batch. `learned` is what `--reward-from` does. `told` pays 1 for demonstrated moves and 0 for the
learner's own, as in SQIL (Reddy et al., ICLR 2020). A constant reward shows what the moves and the end of episodes
teach by themselves: `plus` and `minus` take the last view of an episode to stay, as the learned reward does
(`learning/rl/demonstrated_reward.py`), and `bare-plus` and `bare-minus` let an episode end without a value, as is
usual.

Usage:
    maniskill-tomato demonstrations TomatoViewpointGuided-v1 --episodes 20 --out runs/shown/guided
    maniskill-tomato demonstrations TomatoViewpointSparse-v1 --episodes 20 --out runs/shown/sparse
    python tools/measure_learned_reward.py --demonstrations runs/shown --out runs/learned-reward
"""

import dataclasses
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import h5py
import numpy as np
import torch
import tyro
from torch import Tensor
from torch.nn import functional

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.rollout import run_episodes
from maniskill_tomato.files import write_json, write_tensors
from maniskill_tomato.learning.descent import descend
from maniskill_tomato.learning.imitation.imitation_config import ImitationFitConfig
from maniskill_tomato.learning.rl.agent import make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.demonstrated_reward import stays
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.learning.rl.run_folder import clear_run
from maniskill_tomato.learning.rl.trainer import Trainer, make_training_env
from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.tasks import THESIS_IDS

Teacher = Literal["designed", "learned", "cloned", "told", "plus", "minus", "bare-plus", "bare-minus"]
TASKS: dict[str, str] = dict(zip(("guided", "sparse"), THESIS_IDS, strict=True))


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is measured."""

    demonstrations: Path
    """Folder that has one of `demonstrations` for each task: `guided`, `sparse`."""
    out: Path
    """Folder of the runs and of results.json; what is there is not run again."""
    teachers: tuple[Teacher, ...] = get_args(Teacher)
    """What the policies learn from."""
    tasks: tuple[str, ...] = tuple(TASKS)
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the trainings."""
    steps: int = 15_000
    """Environment steps of each training; the exploration ends after five eighths of them."""
    episodes: int = 100
    """That each policy is judged on."""
    first_seed: int = 1000
    """Of these episodes."""


@dataclass
class FixedReward:
    """A reward model that learns nothing."""

    value: float
    """Of every view that the learner reaches."""
    shown_value: float
    """Of every view that a demonstrated move reaches."""
    gamma: float
    held: bool
    """Whether the last view of an episode counts for ever."""
    own: int = 0
    """Transitions of the learner at the head of a batch."""

    def to(self, device: torch.device) -> None:
        """Holds no tensors."""

    def update(
        self, batch: Batch, normalizer: ObservationNormalizer, generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """Sees how many transitions of a batch are the learner's own."""
        self.own = len(batch.rewards)
        return {}

    def judge(self, batch: Batch, normalizer: ObservationNormalizer) -> Batch:
        """The same for all transitions of one origin, of the size of the learned reward."""
        rewards = torch.full_like(batch.rewards, (1.0 - self.gamma) * self.value)
        rewards[self.own :] = (1.0 - self.gamma) * self.shown_value
        return batch._replace(
            rewards=rewards * stays(batch.terminations, self.gamma) if self.held else rewards
        )

    def state_dict(self) -> dict[str, Any]:
        """Nothing changes."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to take back."""


def train(env_id: str, teacher: Teacher, file: Path, run_dir: Path, seed: int, steps: int) -> None:
    """Trains with a reward model."""
    config = dataclasses.replace(
        get_preset("td3"),
        num_envs=1,
        updates_per_step=0.5,
        total_timesteps=steps,
        exploration_steps=steps * 5 // 8,
        checkpoint_seconds=None,
    )
    model = None
    if teacher != "designed":
        config = dataclasses.replace(config, reward_from=str(file))
    if teacher not in ("designed", "learned"):
        shown = -1.0 if teacher.endswith("minus") else 1.0
        own = 0.0 if teacher == "told" else shown
        model = FixedReward(own, shown, config.gamma, held=not teacher.startswith("bare"))
    clear_run(run_dir)
    env = make_training_env(env_id, config, {})
    try:
        trained = Trainer(env, env_id, config, run_dir, seed, show_progress=False, reward_model=model).run()
    finally:
        env.close()
    if trained.stop_reason != "finished":
        sys.exit(f"stopped by {trained.stop_reason}; the same command goes on with what is missing")


def clone(env_id: str, file: Path, run_dir: Path, seed: int) -> None:
    """Fits the actor of `td3` to the demonstrated moves by their squared error (behaviour cloning)."""
    config: TrainConfig = get_preset("td3")
    with h5py.File(file) as content:
        episodes: list[Any] = [content[name] for name in content]
        observations = torch.from_numpy(np.concatenate([e["obs"][:-1] for e in episodes]))
        actions = torch.from_numpy(np.concatenate([e["actions"][()] for e in episodes]))
    moves = (actions / torch.tensor(config.action_scale)).clamp(-1.0, 1.0)
    torch.manual_seed(seed)
    agent = make_agent(config, observations.shape[1], actions.shape[1])
    seen = agent.normalizer(observations)
    descend(
        agent.actor,
        lambda: functional.mse_loss(agent.actor(seen), moves),
        ImitationFitConfig(seed=seed, steps=5000),
        lambda step, loss: None,
    )
    bounds = -torch.ones(6), torch.ones(6)
    checkpoint = make_checkpoint(
        agent, env_id, bounds, {"seed": seed}, with_training_state=False, env_options={}
    )
    run_dir.mkdir(parents=True, exist_ok=True)
    write_tensors(run_dir / "policy.pt", checkpoint)


def judge(env_id: str, policy: Path, episodes: int, first_seed: int) -> dict[str, float]:
    """Success and length of episodes without exploration."""
    env = make_env(env_id)
    try:
        records = run_episodes(env, open_policy(policy, env_id=env_id), episodes, first_seed)
    finally:
        env.close()
    return {
        "success_percent": 100.0 * sum(e.success for e in records) / episodes,
        "mean_steps": sum(len(e.rewards) for e in records) / episodes,
        "mean_final_visible_fraction": sum(float(e.visible_fraction[-1]) for e in records) / episodes,
    }


def main(options: Options) -> None:
    """Runs what is missing and writes what came of it."""
    path = options.out / "results.json"
    results: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    for seed in options.seeds:
        for teacher in options.teachers:
            for task in options.tasks:
                name = f"{task}/{teacher}/{seed}"
                if name in results:
                    continue
                file, run_dir = options.demonstrations / task / "trajectory.h5", options.out / name
                wall, cpu = time.perf_counter(), time.process_time()
                if teacher == "cloned":
                    clone(TASKS[task], file, run_dir, seed)
                else:
                    train(TASKS[task], teacher, file, run_dir, seed, options.steps)
                seconds = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
                results[name] = {
                    **judge(TASKS[task], run_dir / "policy.pt", options.episodes, options.first_seed),
                    **{key: round(value, 1) for key, value in seconds.items()},
                }
                write_json(path, results)
                print(name, json.dumps(results[name]), flush=True)


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, description=__doc__))
    except TomatoError as error:
        sys.exit(f"error: {error}")
