"""First and last view of the target in an evaluation episode (Fig. 5-9, 5-13, 5-21), where pictures can be taken."""

from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.experiments.reproduction import EVALUATION_SEED, Reproduction, load_episodes
from maniskill_tomato.experiments.rollout import Episode
from maniskill_tomato.experiments.video import make_film_options
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.protocol import StatePolicy
from maniskill_tomato.rendering import vulkan_probe

Image = NDArray[np.uint8]

LEFT_OUT = "Left out because this machine cannot render: the first and last views of the target. {hint}."


def take_all(reproduction: Reproduction, seed: int, folder: Path) -> str | None:
    """Takes `views_<evaluation>.png` for every evaluation: first view, last view, and the scene at the end.

    The episode is the first that training seed `seed` solved, or the first one if it solved none.

    Returns:
        A message if this machine cannot render, else None.
    """
    if not vulkan_probe.rendering_available():
        return LEFT_OUT.format(hint=vulkan_probe.NO_RENDERING_HINT.capitalize())
    folder.mkdir(parents=True, exist_ok=True)
    experiment = reproduction.experiment
    policy = open_policy(reproduction.seed_folder(seed) / "training" / "policy.pt")
    for evaluation in experiment.evaluations:
        episodes = load_episodes(reproduction.episodes_path(seed, evaluation))
        options: dict[str, Any] = {
            "render_backend": vulkan_probe.render_backend(),
            **make_film_options(),
            **evaluation.env_options,
        }
        env = make_env(experiment.env_id, **options)
        try:
            views = first_and_last_view(env, as_state_policy(policy, env), episode_to_show(episodes))
        finally:
            env.close()
        imageio.imwrite(folder / f"views_{evaluation.name}.png", np.concatenate(views, axis=1)[::2, ::2])
    return None


def episode_to_show(episodes: list[Episode]) -> int:
    """Seed of the first solved episode, else of the first one."""
    return next((e.seed for e in episodes if e.success), episodes[0].seed if episodes else EVALUATION_SEED)


def first_and_last_view(env: gym.Env[Any, Any], policy: StatePolicy, seed: int) -> tuple[Image, Image, Image]:
    """What the wrist camera sees before and after an episode, and the scene from outside after it.

    Args:
        env: One environment made with `make_film_options`.
        policy: Chooses the actions.
        seed: Seed of the episode.

    Returns:
        Three pictures of shape (480, 640, 3).
    """
    base = cast(Any, env.unwrapped)
    observations, _ = env.reset(seed=seed)
    first = _wrist(base)
    done = False
    while not done:
        observations, _, terminated, truncated, _ = env.step(policy.act(observations))
        done = bool(terminated) or bool(truncated)
    outside: Image = base.render_rgb_array()[0].cpu().numpy()
    return first, _wrist(base), outside


def _wrist(base: Any) -> Image:
    (sensor,) = base.get_sensor_images().values()
    picture: Image = sensor["rgb"][0].cpu().numpy()
    return picture
