"""Runs the twin of `deploy` and the simulated task on the same held-out episodes with the same policy.

The difference of the two rates is what perception, depth noise, dynamics and the safety checks cost. An episode whose
run cannot begin, or ends with a fault, counts as failed. Stopped at any time, a second call goes on.

Example:
    OMP_NUM_THREADS=1 python scripts/compare_twin.py --profile mock --episodes 100 --out runs/twin
"""

import json
import logging
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import maniskill_tomato  # noqa: F401
from maniskill_tomato.deploy.policies import TASK, default_policy
from maniskill_tomato.deploy.profile import Profile, load_profile
from maniskill_tomato.deploy.run import RunConfig, run
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.benchmark_conditions import main_condition
from maniskill_tomato.experiments.statistics import mcnemar_p, wilson_interval
from maniskill_tomato.experiments.view_rollout import run_view_episode
from maniskill_tomato.files import write_atomically
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.opening import open_policy


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    profile: str = "mock"
    """The twin's: name or TOML file."""
    policy: str | None = None
    """As for `deploy run`; by default the one that ships."""
    episodes: int = 100
    """How many episodes of the held-out list."""
    seed: int = 0
    """The first of them."""
    record: bool = False
    """Keep the recording of every run."""
    out: Path = Path("runs/twin")
    """Folder of episodes.json, summary.json and a folder for each run."""


def on_the_twin(profile: Profile, args: Args, episode: int) -> dict[str, Any]:
    """One run as `deploy run` makes it."""
    began = time.process_time()
    out = args.out / f"{episode:03d}"
    try:
        result = run(
            RunConfig(profile=profile, out=out, policy=args.policy, seed=episode, record=args.record)
        )
    except TomatoError as error:
        return {"success": False, "reason": "cannot begin", "detail": str(error), "steps": []}
    content = result.to_json()
    content["steps"] = json.loads((out / "result.json").read_text())["steps"]
    true_fraction = result.true_visible_fraction
    seen = result.success and true_fraction is not None and true_fraction > profile.loop.threshold
    return {**content, "truly_visible": seen, "cpu_seconds": time.process_time() - began}


def summary(episodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates, their intervals, what differs, and what a look costs."""
    twin = [episode["twin"] for episode in episodes]
    wins = np.array(
        [
            [run["success"], episode["simulation"]["success"]]
            for run, episode in zip(twin, episodes, strict=True)
        ]
    )
    ran = [run for run in twin if "moves" in run]
    stages: dict[str, list[float]] = {}
    for one in ran:
        for step in one["steps"]:
            for stage, taken in step["timing_ms"].items():
                stages.setdefault(stage, []).append(taken)
    only_twin, only_simulation = int((wins[:, 0] & ~wins[:, 1]).sum()), int((~wins[:, 0] & wins[:, 1]).sum())
    return {
        "episodes": len(episodes),
        "twin_success": int(wins[:, 0].sum()),
        "twin_interval_95": wilson_interval(int(wins[:, 0].sum()), len(wins)),
        "twin_success_and_truly_visible": sum(bool(one.get("truly_visible")) for one in twin),
        "simulation_success": int(wins[:, 1].sum()),
        "simulation_interval_95": wilson_interval(int(wins[:, 1].sum()), len(wins)),
        "only_twin": only_twin,
        "only_simulation": only_simulation,
        "mcnemar_p": mcnemar_p(only_twin, only_simulation),
        "reasons": dict(Counter(one["reason"] for one in twin)),
        "failed": [e["episode"] for e, won in zip(episodes, wins[:, 0], strict=True) if not won],
        "simulation_failed": [e["episode"] for e, won in zip(episodes, wins[:, 1], strict=True) if not won],
        "twin_moves_of_successes": float(np.mean([one["moves"] for one in ran if one["success"]])),
        "simulation_moves_of_successes": float(
            np.mean([e["simulation"]["moves"] for e in episodes if e["simulation"]["success"]])
        ),
        "refused_share_of_moves": sum(one["refused_moves"] for one in ran) / sum(one["moves"] for one in ran),
        "simulation_contact_share_of_episodes": float(
            np.mean([e["simulation"]["contact"] for e in episodes])
        ),
        "stage_ms_mean": {stage: round(float(np.mean(taken)), 2) for stage, taken in stages.items()},
        "stage_ms_p95": {stage: round(float(np.percentile(taken, 95)), 2) for stage, taken in stages.items()},
        "looks": sum(len(one["steps"]) for one in ran),
        "cpu_seconds_a_run": float(np.mean([one["cpu_seconds"] for one in ran])),
        "device_seconds_median": float(np.median([one["device_seconds"] for one in ran])),
    }


def main(argv: list[str] | None = None) -> None:
    """Compares; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    try:
        args = tyro.cli(Args, args=argv, description=__doc__)
        profile = load_profile(args.profile)
        store = args.out / "episodes.json"
        done: list[dict[str, Any]] = json.loads(store.read_text()) if store.is_file() else []
        policy = open_policy(args.policy or default_policy(), env_id=TASK)
        env = make_env(TASK, **main_condition("held_out").env_options)
        for episode in range(args.seed, args.seed + args.episodes):
            if any(one["episode"] == episode for one in done):
                continue
            simulated = run_view_episode(env, policy, episode)
            twin = on_the_twin(profile, args, episode)
            simulation = {
                "success": simulated.success,
                "moves": simulated.moves,
                "contact": bool(simulated.contact.any()),
                "visible_fraction": round(float(simulated.visible_fraction[-1]), 4),
            }
            done.append({"episode": episode, "twin": twin, "simulation": simulation})
            write_atomically(store, json.dumps(done).encode())
            print(
                f"{episode:3d}  twin {twin['reason']:12} {twin.get('moves', 0):2d} moves   "
                f"simulation {'success' if simulated.success else 'failure'} {simulated.moves:2d} moves",
                flush=True,
            )
        content = json.dumps(summary(done), indent=1)
        write_atomically(args.out / "summary.json", (content + "\n").encode())
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(content)


if __name__ == "__main__":
    main()
