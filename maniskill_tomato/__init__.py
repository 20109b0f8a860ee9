"""Active perception for tomato harvesting, as a ManiSkill plugin.

Importing this package registers the tasks by name; ManiSkill, SAPIEN and PyTorch load only when
`gymnasium.make` builds one.
"""

from maniskill_tomato import tasks as tasks

__version__ = "0.2.0.dev0"
