"""`maniskill-tomato eval`: how good a policy is."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_choice, check_counts, check_env_id, check_policy
from maniskill_tomato.cli.shared_options import EnvId, PlantOptions, camera_options
from maniskill_tomato.plants.episode_list import EPISODE_LISTS
from maniskill_tomato.policies.opening import shipped_policy

LISTED_ID = "TomatoViewpoint-v1"
"""The task that has lists of episodes."""


@dataclass(frozen=True, kw_only=True)
class Eval:
    """Evaluate a policy: metrics.json, plots, a film and report.html."""

    env_id: EnvId
    """Id of the task."""
    policy: str | None = None
    """File of the policy (.pt, or .onnx from `export`), or `random`, or for the general tasks a planner's name; by
    default the one that ships with the package."""
    episodes: int = 100
    """How many episodes."""
    seed: int = 1000
    """Seed of the first episode; the others follow."""
    num_envs: int = 1
    """Environments stepped at once, which gives the same episodes; on a CPU one is as fast. Policies that draw random
    numbers get one."""
    out: Path = Path("runs/eval")
    """Folder of the results."""
    baseline: bool = True
    """Also run random actions, to compare."""
    beside: str = ""
    """Other policies to run on the same episodes, with commas between them: planners such as nbv or lattice_oracle, or
    files. The report has a column for each."""
    video: bool = True
    """Film some episodes where this machine can render."""
    allow_other_task: bool = False
    """Accept a policy that was trained on another task."""
    plants: Annotated[PlantOptions, Flat] = PlantOptions()
    """Another plant."""
    episode_list: str | None = None
    """Episodes of a fixed list, TomatoViewpoint-v1 only: validation, held_out, or a file of
    `tools/certify_episodes.py`. Seed i is its i-th; by default held_out, unless options of the plants are given."""

    perception: str = "ground_truth"
    """What V_f and the target's position come from: ground_truth, occlusion_model, simulated_segmenter,
    thesis_model, improved_model or segmenter; the general tasks only."""
    target: str | None = None
    """How the target is named to a robot that sees through a camera: track (the default), map or any;
    TomatoViewpoint-v1 only."""
    map_noise: float | None = None
    """With --target map: standard deviation of each coordinate of the place that is given, in [m]; 0.03 by default."""

    def run(self) -> None:
        """Evaluates and says where the report is."""
        check_env_id(self.env_id)
        check_counts(episodes=self.episodes, num_envs=self.num_envs)
        env_id = None if self.allow_other_task else self.env_id
        check_policy("--policy", self.policy or shipped_policy(self.env_id), env_id)
        beside = tuple(dict.fromkeys(name.strip() for name in self.beside.split(",") if name.strip()))
        for name in beside:
            check_policy("--beside", name, env_id)
        if self.episode_list is not None and not Path(self.episode_list).is_file():
            check_choice("--episode-list", self.episode_list, (*EPISODE_LISTS, "FILE.json"))

        from maniskill_tomato.experiments.configs import EvaluationConfig
        from maniskill_tomato.experiments.evaluation import evaluate

        config = EvaluationConfig(
            env_id=self.env_id,
            policy=self.policy,
            episodes=self.episodes,
            seed=self.seed,
            out=self.out,
            num_envs=self.num_envs,
            allow_other_task=self.allow_other_task,
            env_options=self.options_of_task(),
            baseline=self.baseline,
            beside=beside,
            video=self.video,
            title="Where to look: evaluation",
        )
        result = evaluate(config)
        print(f"policy  {result.origin}")
        print(summary(result.metrics))
        if "true_success_rate" in result.metrics:
            print(camera_summary(result.metrics))
        if "recall" in result.metrics:
            print(inspection_summary(result.metrics))
        for line in beside_summary(result.metrics):
            print(line)
        if result.left_out:
            print(result.left_out)
        print(f"metrics {self.out / 'metrics.json'}")
        print(f"report  {result.report}")

    def options_of_task(self) -> dict[str, Any]:
        """The options for `gymnasium.make`.

        Raises:
            InvalidInputError: One is not allowed.
        """
        options = self.plants.env_options()
        if self.episode_list is not None or (self.env_id == LISTED_ID and not options):
            options["episodes"] = self.episode_list or "held_out"
        return options | camera_options(self.env_id, self.perception, self.target, self.map_noise)


def beside_summary(metrics: dict[str, Any]) -> list[str]:
    """One line for each other policy that ran on the same episodes."""
    others = {**metrics.get("beside", {})}
    if "random_actions" in metrics:
        others = {"random actions": metrics["random_actions"], **others}
    return [
        f"        {name}: success {other['success_rate']:.0%}, {other['mean_steps']:.1f} steps"
        for name, other in others.items()
    ]


def camera_summary(metrics: dict[str, Any]) -> str:
    """One line with what a camera's success was worth."""
    return (
        f"truly full: the target {metrics['true_success_rate']:.0%}, the chosen fruit "
        f"{metrics['chosen_success_rate']:.0%}, with a true association "
        f"{metrics['true_association_success_rate']:.0%}; false stops {metrics['false_stop_rate']:.0%}"
    )


def inspection_summary(metrics: dict[str, Any]) -> str:
    """One line with what the inspection lists of rows are worth."""
    recall, precision = (
        "none" if metrics[key] is None else f"{metrics[key]:.1%}" for key in ("recall", "precision")
    )
    error = metrics["position_error_median_m"]
    place = "unknown" if error is None else f"{1e3 * error:.1f} mm"
    return (
        f"inspection: {recall} of the seeable ripe fruits truly seen, precision {precision}, place {place} (median), "
        f"{metrics['mean_moves']:.1f} moves a row"
    )


def summary(metrics: dict[str, Any]) -> str:
    """One line with the figures that matter."""
    low, high = metrics["success_rate_interval_95"]
    return (
        f"success {metrics['success_rate']:.0%} of {metrics['episodes']} episodes "
        f"(95 % interval {low:.0%} to {high:.0%}), "
        f"{metrics['mean_steps']:.1f} steps, largest V_f {metrics['mean_max_visible_fraction']:.2f} on average"
    )
