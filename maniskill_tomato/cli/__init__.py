"""The command `maniskill-tomato`: train, evaluate, compare, demonstrate, export, deploy.

Examples:
    maniskill-tomato train TomatoViewpointGuided-v1
    maniskill-tomato train TomatoViewpointSparse-v1 --preset thesis-sparse --seeds 0..4 --jobs 2
    maniskill-tomato train --resume runs/guided
    maniskill-tomato eval TomatoViewpointGuided-v1 --policy runs/demo/training/policy.pt --episodes 100
    maniskill-tomato benchmark --policies nbv,oracle,runs/general/policy.pt --episodes 500
    maniskill-tomato demo
    maniskill-tomato export --policy runs/demo/training/policy.pt --out exported
    maniskill-tomato deploy run --profile mock --out runs/deploy
    maniskill-tomato dataset --count 1000 --split train --out runs/dataset
    maniskill-tomato detect photos --out detections.json
"""

import logging
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from maniskill_tomato.cli.benchmark import Benchmark
from maniskill_tomato.cli.dataset import Dataset
from maniskill_tomato.cli.demo import Demo
from maniskill_tomato.cli.deploy import Deploy
from maniskill_tomato.cli.detect import Detect
from maniskill_tomato.cli.evaluate import Eval
from maniskill_tomato.cli.export import Export
from maniskill_tomato.cli.options import PlantOptions, merge_options
from maniskill_tomato.cli.train import Train, train_default
from maniskill_tomato.errors import TomatoError

__all__ = [
    "Benchmark",
    "Dataset",
    "Demo",
    "Deploy",
    "Detect",
    "Eval",
    "Export",
    "PlantOptions",
    "Train",
    "main",
    "merge_options",
    "parse",
]

Command = Train | Eval | Benchmark | Demo | Export | Dataset | Detect | Deploy

# PyTorch and ManiSkill take seconds to import, so that every command imports what it needs when it runs.


def parse(argv: Sequence[str]) -> Command:
    """The command that the arguments describe.

    The options of `train` default to those of the run that it continues or of its `--config` file, and these to
    those of its `--preset`.

    Raises:
        InvalidInputError: The file or the run cannot be used.
    """
    default = train_default(argv) if "train" in argv[:1] else Train()
    commands: Any = (
        Annotated[Train, tyro.conf.subcommand("train", default=default)]
        | Annotated[Eval, tyro.conf.subcommand("eval")]
        | Annotated[Benchmark, tyro.conf.subcommand("benchmark")]
        | Annotated[Demo, tyro.conf.subcommand("demo")]
        | Annotated[Export, tyro.conf.subcommand("export")]
        | Annotated[Dataset, tyro.conf.subcommand("dataset")]
        | Annotated[Detect, tyro.conf.subcommand("detect")]
        | Annotated[Deploy, tyro.conf.subcommand("deploy")]
    )
    command: Command = tyro.cli(
        commands,
        prog="maniskill-tomato",
        description="Active perception for tomato harvesting: train, evaluate, compare, demonstrate, export, deploy.",
        args=list(argv),
        config=(tyro.conf.OmitArgPrefixes,),
    )
    return command


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        parse(sys.argv[1:] if argv is None else argv).run()
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:
        # Whoever read the output, such as `head`, has gone; what is still buffered must not fail at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
