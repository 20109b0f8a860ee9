"""What a policy loses when it sees through the camera instead of the simulator, on the same held-out episodes.

An episode ends when the robot believes that the target is fully visible, or after the last move. It is a success if
that is then true.

Usage:
    python scripts/compare_perception.py --policies nbv --episodes 100 --out runs/perception
"""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import torch
import tyro
from tqdm import tqdm

import maniskill_tomato  # noqa: F401  (registers the tasks)
from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.experiments.benchmark_policies import parse_policies
from maniskill_tomato.files import write_atomically
from maniskill_tomato.sensing.simulated_camera import RENDERED, Perception

PERCEPTIONS = get_args(Perception)


@dataclass(frozen=True, kw_only=True)
class Args:
    """Compare perceptions."""

    policies: str = "nbv"
    """Names of planners, files of trained policies, or LABEL=FILE, with commas between them."""
    episodes: int = 100
    """How many of the list."""
    seed: int = 0
    """The first of them."""
    episode_list: str = "held_out"
    """Which fixed list."""
    perceptions: tuple[str, ...] = ("ground_truth", "occlusion_model")
    """What the policies see through; `segmenter` and the thesis's models need a renderer and seconds for a move."""
    out: Path = Path("runs/perception")
    """Folder of the results."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """One episode."""

    policy: str
    perception: str
    episode: int
    declared: bool
    """Whether the robot took the target for fully visible at the end."""
    true_fraction: float
    """True V_f of the last view."""
    success: bool
    """Whether that is above the task's threshold."""
    moves: int
    fraction_error: float
    """Mean absolute error of V_f over the episode's views after a move."""
    position_error_m: float
    """Distance between where the target is and where it was believed to be at the end, in [m]."""


def run_episode(env: gym.Env[Any, Any], policy: Any, label: str, perception: str, episode: int) -> Result:
    """Runs one episode."""
    world: Any = env.unwrapped
    if (reseed := getattr(policy, "reseed", None)) is not None:
        reseed(episode)
    env.reset(seed=episode)
    policy.begin(world.belief, torch.zeros(1, dtype=torch.int64))
    errors, moves, ended = [], 0, False
    info: dict[str, Any] = {}
    while not ended:
        _, _, terminated, truncated, info = env.step(policy.act(world.belief))
        moves += 1
        measured = float(info["visible_fraction"][0])
        errors.append(abs(measured - float(info.get("true_visible_fraction", info["visible_fraction"])[0])))
        ended = bool(terminated) or bool(truncated)
    true = float(info.get("true_visible_fraction", info["visible_fraction"])[0])
    believed = world.belief.target_position[0]
    return Result(
        policy=label,
        perception=perception,
        episode=episode,
        declared=bool(info["success"][0]),
        true_fraction=true,
        success=bool(info["success"][0]) and true > world.task.full_visibility,
        moves=moves,
        fraction_error=float(np.mean(errors)),
        position_error_m=float((believed - world._target_position_w[0]).norm()),
    )


def table(results: list[Result]) -> str:
    """The results as Markdown."""
    lines = [
        "| policy | perception | episodes | success | believed success | mean moves | V_f error | position error |"
    ]
    lines.append("|---" * 8 + "|")
    for policy, perception in dict.fromkeys((r.policy, r.perception) for r in results):
        rows = [r for r in results if (r.policy, r.perception) == (policy, perception)]
        mean = {
            key: float(np.mean([getattr(r, key) for r in rows]))
            for key in ("success", "declared", "moves", "fraction_error", "position_error_m")
        }
        lines.append(
            f"| {policy} | {perception} | {len(rows)} | {100 * mean['success']:.0f} % | {100 * mean['declared']:.0f} % "
            f"| {mean['moves']:.1f} | {mean['fraction_error']:.3f} | {1000 * mean['position_error_m']:.0f} mm |"
        )
    return "\n".join(lines) + "\n"


def main(args: Args) -> None:
    """Runs what is not yet in the results and writes them after every episode."""
    for name in args.perceptions:
        if name not in PERCEPTIONS:
            raise InvalidInputError.choice("--perceptions", name, PERCEPTIONS)
    if args.episodes < 1:
        raise InvalidInputError(f"--episodes must be 1 or more, got {args.episodes}")
    path = args.out / "perception.json"
    results = [Result(**r) for r in json.loads(path.read_text())] if path.is_file() else []
    done = {(r.policy, r.perception, r.episode) for r in results}
    for perception in args.perceptions:
        env = gym.make(
            "TomatoViewpoint-v1",
            episodes=args.episode_list,
            obs_mode="state",
            render_backend="auto" if perception in RENDERED else "none",
            perception=perception,
        )
        for spec in parse_policies(args.policies):
            policy = spec.make(env)
            for episode in tqdm(
                range(args.seed, args.seed + args.episodes), desc=f"{spec.label} {perception}", disable=None
            ):
                if (spec.label, perception, episode) not in done:
                    results.append(run_episode(env, policy, spec.label, perception, episode))
                    write_atomically(path, json.dumps([asdict(r) for r in results]).encode())
        env.close()
    text = table(results)
    write_atomically(args.out / "perception.md", text.encode())
    print(text)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
