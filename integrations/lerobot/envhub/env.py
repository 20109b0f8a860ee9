"""The tasks of maniskill-tomato for EnvHub; `pip install maniskill-tomato` first."""

from maniskill_tomato.tasks.lerobot_env import make_env

__all__ = ["make_env"]
