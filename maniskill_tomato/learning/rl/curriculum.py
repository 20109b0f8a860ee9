"""A curriculum over leaf density: plants of few leaves first, all of the task's later."""

from typing import Any, Protocol, runtime_checkable

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.envs import LearnerEnv
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.tasks.vector_env import VectorEnv


@runtime_checkable
class LimitsLeafDensity(Protocol):
    """An environment whose plants have different leaf densities."""

    @property
    def leaf_density_range(self) -> tuple[float, float]:
        """Of the plants that it draws without a limit."""
        ...

    def limit_leaf_density(self, highest: float) -> None:
        """From the next reset on, draws only plants up to this density."""
        ...


class LeafDensityCurriculum:
    """Raises the limit linearly from `leaf_density_start` to the task's highest within `leaf_density_steps`."""

    def __init__(self, config: TrainConfig, env: LearnerEnv) -> None:
        """Finds out what the environment draws.

        Args:
            config: Where the curriculum starts, None for none, and how long it lasts.
            env: The learner's.

        Raises:
            InvalidInputError: The environment's plants have one density, or none below the start.
        """
        self._start, self._steps = config.leaf_density_start, config.leaf_density_steps
        if self._start is None:
            return
        game: Any = env.world.game if isinstance(env, VectorEnv) else getattr(env, "base_env", env)
        if not isinstance(game, LimitsLeafDensity):
            raise InvalidInputError(
                "leaf_density_start needs a task whose plants differ in leaf density: TomatoViewpoint-v1 or "
                "TomatoViewpointRow-v1; leave it out"
            )
        self._game: LimitsLeafDensity = game
        low, self._highest = self._game.leaf_density_range
        if not low < self._start < self._highest:
            raise InvalidInputError(
                f"leaf_density_start must lie within the plants' leaf density, {low} to {self._highest}; got "
                f"{self._start}"
            )

    def limit(self, step: int) -> float | None:
        """The highest density at a step; None without a curriculum."""
        if self._start is None:
            return None
        return self._start + (self._highest - self._start) * min(step / self._steps, 1.0)

    def apply(self, step: int) -> None:
        """Tells the environment the limit of a step."""
        limit = self.limit(step)
        if limit is not None:
            self._game.limit_leaf_density(limit)
