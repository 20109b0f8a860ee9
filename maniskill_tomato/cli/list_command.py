"""`list`: what can be named in commands and options, this package's and that of others."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

import tyro

from maniskill_tomato.cli.early_checks import check_choice
from maniskill_tomato.extension_points import OWN_PACKAGE, Extension, ExtensionPoint

KINDS: Final = ("tasks", "policies", "segmenters", "plants", "arms", "cameras", "models")


def extension_points() -> Mapping[str, ExtensionPoint]:
    """Each kind's names; nothing that they stand for is imported."""
    from maniskill_tomato.deploy.drivers import DRIVERS
    from maniskill_tomato.plants.plant_generators import PLANT_GENERATORS
    from maniskill_tomato.policies.registry import POLICIES
    from maniskill_tomato.segmentation.segmenter import SEGMENTERS
    from maniskill_tomato.task_registry import TASKS

    points = (
        TASKS,
        POLICIES,
        SEGMENTERS,
        PLANT_GENERATORS,
        DRIVERS["arm"],
        DRIVERS["camera"],
        DRIVERS["model"],
    )
    return dict(zip(KINDS, points, strict=True))


@dataclass(frozen=True, kw_only=True)
class List:
    """List the tasks, policies, segmenters, plants, drivers and arm models that there are, and whose they are."""

    kind: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="KIND")] = None
    """One of tasks, policies, segmenters, plants, arms, cameras, models; all if left out."""

    def run(self) -> None:
        """Prints a table for each kind."""
        if self.kind is not None:
            check_choice("KIND", self.kind, KINDS)
        from maniskill_tomato.plants.kinds import PLANT_NAMES

        points = extension_points()
        for kind in KINDS if self.kind is None else (self.kind,):
            found = points[kind].extensions()
            if kind == "plants":
                found = (*(Extension(name, "", OWN_PACKAGE) for name in PLANT_NAMES), *found)
            print(f"{kind} ({points[kind].group})")
            width = max(len(extension.name) for extension in found)
            for extension in found:
                others = f", and also {', '.join(extension.others)}" if extension.others else ""
                print(f"  {extension.name:<{width}}  {extension.origin or 'unknown package'}{others}")
