"""`maniskill-tomato reproduce` and `ablate`: trainings over seeds, judged and put side by side."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from maniskill_tomato.cli.early_checks import check_choice
from maniskill_tomato.experiments.configs import AblationConfig, ExperimentName, ReproductionConfig
from maniskill_tomato.experiments.variants import choose_variants, experiments, find_variant
from maniskill_tomato.learning.rl.presets import PRESETS
from maniskill_tomato.tasks import TASK_IDS


def _say(line: str) -> None:
    print(line, flush=True)


@dataclass(frozen=True, kw_only=True)
class Reproduce(ReproductionConfig):
    """Reproduce an experiment of the thesis over several seeds and draw the counterparts of its figures.

    What is already there is kept, so that it can be stopped and started again.
    """

    experiment: Annotated[ExperimentName, tyro.conf.Positional]
    """guided: section 5-1; sparse: section 5-2."""

    def run(self) -> None:
        """Trains and judges what is missing, and says where the results are."""
        for name in self.variant:
            find_variant(experiments()[self.experiment], name)

        from maniskill_tomato.experiments.reproduction import run_reproduction

        run_reproduction(self, _say)


@dataclass(frozen=True, kw_only=True)
class Ablate(AblationConfig):
    """Compare a preset with variants of it that change one option each, over seeds and tasks.

    What is already there is kept, so that it can be stopped and started again; the table is written after every run.
    """

    def run(self) -> None:
        """Trains and judges what is missing, and prints the table."""
        check_choice("--preset", self.preset, tuple(PRESETS))
        choose_variants(self.variants)
        for env_id in self.env_ids:
            check_choice("--env-ids", env_id, TASK_IDS)

        from maniskill_tomato.experiments.ablation import run_ablation

        _say(run_ablation(self, _say))
