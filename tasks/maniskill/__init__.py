"""The ManiSkill side of the tasks: robot agent, controllers, actors, scene."""

from importlib.util import find_spec

from maniskill_tomato.errors import MissingPackageError

if find_spec("mani_skill") is None:
    raise MissingPackageError.simulator()
