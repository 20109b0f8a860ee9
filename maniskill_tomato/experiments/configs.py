"""What each experiment is asked to do. The command line fills these; nothing here is slow to import."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.sensing.perception_kinds import Perception
from maniskill_tomato.task_registry import GENERAL_IDS
from maniskill_tomato.tasks import Scene

ExperimentName = Literal["guided", "sparse"]

DEFAULT_POLICIES = (
    "random_viewpoint,fixed_sweep,3dmts,gradient_nbv,nbv_direction,nbv,view_quality,greedy_truth,oracle"
)


def check_positive(**values: int | None) -> None:
    """Raises an `InvalidInputError` for the first value below 1; None is accepted."""
    for name, value in values.items():
        if value is not None and value < 1:
            raise InvalidInputError(f"--{name.replace('_', '-')} must be 1 or more, got {value}")


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Raises an `InvalidInputError` unless these are one or more different numbers of 0 or more."""
    if not seeds or len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise InvalidInputError(f"--seeds must be one or more different numbers of 0 or more, got {seeds}")


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """What to evaluate and what to write."""

    env_id: str
    policy: str | None = None
    """File of the policy (.pt, or .onnx), `random`, or a planner's name; by default the one that ships."""
    episodes: int
    seed: int
    out: Path
    """Folder of the results."""
    num_envs: int = 1
    """Environments stepped at once; a policy that draws random numbers gets one."""
    allow_other_task: bool = False
    """Accept a policy that was trained on another task."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options for `gymnasium.make` beside the defaults, for instance another plant."""
    baseline: bool = True
    """Also run uniformly random actions from the same seeds."""
    beside: tuple[str, ...] = ()
    """Other policies, by name or file, to run from the same seeds."""
    video: bool = True
    """Film episodes where the machine can render."""
    films: int = 3
    """How many: solved ones first, and of these the ones nearest to `evaluation_report.FILM_MOVES` moves."""
    title: str = "Evaluation"
    training_run: Path | None = None
    """A run whose training curves the report shows; by default the one beside the policy, if there is one."""
    show_progress: bool = True


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig:
    """Compare policies on the same held-out episodes: benchmark.json, plots and report.html."""

    policies: str = DEFAULT_POLICIES
    """Names of planners, files of trained policies, or LABEL=FILE, with commas between them."""
    env_id: str = GENERAL_IDS[0]
    """The task. Another one than TomatoViewpoint-v1 has no list: its episodes are drawn from their seeds."""
    episodes: int = 500
    """How many episodes of the list."""
    episode_list: str = "held_out"
    """Which fixed list: held_out to report, validation to choose, or a file of `tools/certify_episodes.py`."""
    plants: str | None = None
    """Run on other plants instead: a folder of mesh files, or varied or other_kind, plants of many kinds from our
    generator. The held-out ones, or FOLDER:SPLIT with train, validation, held_out or all. Hidden starts are drawn on
    each plant, and those that the lattice oracle solves are the episodes."""
    seed: int = 0
    """The first of them."""
    out: Path = Path("runs/benchmark")
    """Folder of the results. A benchmark that was stopped goes on there, and one with more policies or episodes keeps
    what is done."""
    jobs: int | None = None
    """Processes at a time; by default one per processor core."""
    num_envs: int = 1
    """Environments that each process steps at once; on a CPU one is as fast. Policies that draw random numbers get
    one."""
    sweeps: str = ""
    """Also sweep over these, with commas: leaf_density, start_visibility, segmentation, depth, pose; or `all`."""
    sweep_episodes: int = 100
    """Episodes for each value of a sweep."""
    sweep_policies: str = ""
    """Which of the policies to sweep; all by default."""
    contact_free_oracle: bool = False
    """Let the oracle avoid the plant."""
    pictures: bool = True
    """Draw a grid of last views where this machine can render."""

    def __post_init__(self) -> None:
        check_positive(jobs=self.jobs, num_envs=self.num_envs)


@dataclass(frozen=True, kw_only=True)
class RowBenchmarkConfig:
    """Judge policies on rows: how many of the tomatoes that can be seen they see, and what it costs.

    Which tomatoes can be seen is asked of the truth, once for every row.
    """

    policies: str = "view_quality,nbv,random_viewpoint"
    """Names of planners, files of trained policies, or LABEL=FILE, with commas between them."""
    rows: int = 30
    """How many rows."""
    seed: int = 1000
    """Seed of the first; the others follow."""
    split: str = "held_out"
    """Split of the plants: held_out to report, validation to choose."""
    transits: str = "both"
    """When the arm goes by its ready posture: none, target, refused or both."""
    perception: Perception = "ground_truth"
    """What the robot knows: ground_truth, or what it sees through a camera (occlusion_model, simulated_segmenter,
    segmenter, thesis_model or improved_model); it then chooses its targets itself, and its inspection list is
    judged."""
    jobs: int = 1
    """Processes at a time."""
    out: Path = Path("runs/rows")
    """Folder of the results; rows that are there are not searched again."""

    def __post_init__(self) -> None:
        check_positive(rows=self.rows, jobs=self.jobs)


@dataclass(frozen=True, kw_only=True)
class PerceptionComparisonConfig:
    """Measure what a policy loses when it sees through the camera instead of the simulator, on the same episodes.

    An episode ends when the robot believes that the target is fully visible, or after the last move. It is a success
    if that is then true.
    """

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
    jobs: int = 1
    """Processes at a time."""
    out: Path = Path("runs/perception")
    """Folder of the results; episodes that are there are not run again."""

    def __post_init__(self) -> None:
        check_positive(episodes=self.episodes, jobs=self.jobs)


@dataclass(frozen=True, kw_only=True)
class TwinConfig:
    """Run the twin of `deploy` and the simulated task on the same episodes with the same policy.

    The difference of the two rates is what perception, depth noise, dynamics and the safety checks cost. An episode
    whose run cannot begin, or ends with a fault, counts as failed.
    """

    profile: str = "mock"
    """The twin's: name or TOML file. Its `twin.episodes` says from which list the episodes are."""
    policy: str | None = None
    """As for `deploy run`; by default the one that ships."""
    inspect: bool = False
    """Inspect the whole row of every episode, as `deploy inspect` does, and judge the lists by the truth, as those of
    `benchmark-rows --perception` are."""
    episodes: int = 100
    """How many episodes of the list."""
    seed: int = 0
    """The first of them."""
    record: bool = False
    """Keep the recording of every run."""
    out: Path = Path("runs/twin")
    """Folder of summary.json and a folder for each run; episodes that are there are not run again."""

    def __post_init__(self) -> None:
        check_positive(episodes=self.episodes)


@dataclass(frozen=True, kw_only=True)
class RunComparisonConfig:
    """Compare training runs: a report with a table over seeds and training curves over steps and time.

    Runs of the same task and options are one configuration; their seeds give the interquartile mean and its 95 %
    interval. A folder that holds run folders stands for all of them.
    """

    runs: tuple[Path, ...]
    """Run folders, or folders that hold some."""
    out: Path = Path("runs/comparison")
    """Folder of the report."""
    evaluate: int | None = None
    """First judge the runs that have no evaluation, in this many episodes on the plants of their training."""
    eval_seed: int = 1000
    """Seed of the first of these episodes; the others follow."""

    def __post_init__(self) -> None:
        check_positive(evaluate=self.evaluate)


@dataclass(frozen=True, kw_only=True)
class AblationConfig:
    """Compare a preset with variants of it that change one option each, over seeds and tasks.

    What is already there is kept, so that it can be stopped and started again; the table is written after every run.
    """

    preset: str = "td3"
    """The configuration that is varied."""
    variants: tuple[str, ...] = ()
    """Names of variants; by default all."""
    env_ids: tuple[str, ...] = ("TomatoViewpointGuided-v1", "TomatoViewpointSparse-v1")
    """Tasks."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Training seeds."""
    episodes: int = 100
    """Evaluation episodes of each run."""
    total_timesteps: int | None = None
    """Another length of the training than the preset's, for trials."""
    jobs: int = 1
    """Runs at a time."""
    out: Path = Path("runs/ablation")
    """Folder of the runs and of ablation.json and report.html."""

    def __post_init__(self) -> None:
        check_positive(episodes=self.episodes, jobs=self.jobs)
        check_seeds(self.seeds)


@dataclass(frozen=True, kw_only=True)
class ReproductionConfig:
    """Reproduce an experiment of the thesis over several seeds and draw the counterparts of its figures.

    What is already there is kept, so that it can be stopped and started again.
    """

    experiment: ExperimentName
    """guided: section 5-1; sparse: section 5-2."""
    scene: Scene = "thesis"
    """Plant, pose and camera: the thesis's, or hidden from every start."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Training seeds."""
    out: Path = Path("runs/thesis")
    """Folder of the results; each experiment and variant gets one in it."""
    variant: tuple[str, ...] = ()
    """Names of variants; by default the exact settings alone, or all of them with --ablate. A+B makes two changes, and
    td3-without-A+B puts two parts of the preset td3 back to the exact settings."""
    ablate: bool = False
    """Judge each variant at the training pose only, draw nothing, and write their table as report.html."""
    episodes: int = 100
    """Evaluation episodes; the first six are the thesis's."""
    untrained: int = 200
    """Freshly initialised actors whose first step is examined."""
    views: bool = True
    """Take the first and last view of the target where this machine can render."""
    training_episodes: int | None = None
    """Another length of the training, for trials."""
    jobs: int = 1
    """Trainings at a time."""
    progress: bool = True
    """Draw progress bars."""

    def __post_init__(self) -> None:
        check_positive(episodes=self.episodes, jobs=self.jobs, training_episodes=self.training_episodes)
        check_seeds(self.seeds)
