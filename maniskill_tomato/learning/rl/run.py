"""One training run from its description: the environment made, trained in, and closed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from maniskill_tomato.learning.rl.envs import LearnerEnv, check_env_id, make_learner_env
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.learning.rl.progress import Progress
from maniskill_tomato.learning.rl.run_folder import check_run_dir, clear_run
from maniskill_tomato.learning.rl.trainer import Trainer, TrainResult


def train(
    env_id: str,
    config: TrainConfig,
    run_dir: Path,
    seed: int,
    env_options: dict[str, Any],
    *,
    overwrite: bool = False,
    resume: bool = False,
    show_progress: bool = True,
    report: Callable[[Progress], None] | None = None,
) -> TrainResult:
    """Trains in `run_dir`.

    Args:
        env_id: Id of the task.
        config: How to learn.
        run_dir: Folder of the run.
        seed: Seed of everything that is random.
        env_options: Options of the task for `gymnasium.make`.
        overwrite: Remove an earlier run from the folder.
        resume: Go on with the run in the folder.
        show_progress: Whether to draw a progress bar.
        report: Called about twice a second with where the run is.

    Raises:
        InvalidInputError: The id, an option or the folder cannot be used.
        CheckpointError: The run cannot be saved or continued.
        TrainingDivergedError: Something is not finite any more.
    """
    check_env_id(env_id)
    if overwrite:
        clear_run(run_dir)
    if not resume:
        check_run_dir(run_dir)
    env = make_training_env(env_id, config, env_options)
    try:
        trainer = Trainer(
            env,
            env_id,
            config,
            run_dir,
            seed,
            show_progress,
            env_options=env_options,
            resume=resume,
            report=report,
        )
        return trainer.run()
    finally:
        env.close()


def make_training_env(env_id: str, config: TrainConfig, env_options: dict[str, Any]) -> LearnerEnv:
    """The environments that a configuration trains in, telling what its hindsight needs.

    Raises:
        InvalidInputError: The id or an option cannot be used.
    """
    needed = {"other_targets": config.hindsight_targets} if config.hindsight_targets else {}
    return make_learner_env(env_id, config.num_envs, **{**needed, **env_options})
