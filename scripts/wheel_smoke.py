"""Tries an installed maniskill-tomato as a user would: the tasks by their IDs, a few steps, the command line.

Usage:
    cd /somewhere/else && python -I /path/to/scripts/wheel_smoke.py

Run it with the interpreter of the environment that the wheel was installed into, as `make build` does.
It needs no Vulkan.
"""

import importlib.util
import subprocess
import sys
from pathlib import Path

N_STEPS = 3
TASK_IDS = ("TomatoViewpointGuided-v1", "TomatoViewpointSparse-v1")
INFO_KEYS = ("success", "visible_fraction", "target_id")
FILES = ("py.typed", "assets/iiwa14/iiwa14.urdf")
FOREIGN_NAMES = ("tasks", "assets", "deploy", "scripts", "tests", "tools")


class SmokeFailure(Exception):
    """The installed package does not behave as promised."""


def require(condition: bool, message: str) -> None:
    """Raise `SmokeFailure(message)` unless the condition holds."""
    if not condition:
        raise SmokeFailure(message)


def check_files() -> str:
    """The package comes from site-packages, is complete, and brings no generic top-level name."""
    import maniskill_tomato

    package = Path(maniskill_tomato.__file__).resolve().parent
    require(
        "site-packages" in package.parts,
        f"maniskill_tomato comes from {package}, not from an installed wheel",
    )
    missing = [name for name in FILES if not (package / name).is_file()]
    require(not missing, f"the wheel lacks {missing}")
    foreign = [name for name in FOREIGN_NAMES if importlib.util.find_spec(name) is not None]
    require(not foreign, f"the generic names {foreign} can be imported")
    heavy = sorted({"torch", "sapien", "mani_skill", "warp"} & set(sys.modules))
    require(not heavy, f"`import maniskill_tomato` loads {heavy}")
    return f"maniskill-tomato {maniskill_tomato.__version__} in {package}"


def check_task(env_id: str) -> str:
    """The task can be made, reset and stepped without rendering, and its info has the promised entries."""
    import gymnasium as gym

    env = gym.make(env_id, num_envs=1, obs_mode="state", render_backend="none")
    try:
        observation, _ = env.reset(seed=0)
        for _ in range(N_STEPS):
            observation, reward, _, _, info = env.step(env.action_space.sample())
            shape = getattr(reward, "shape", None)
            require(shape == (1,), f"{env_id}: the reward has the shape {shape} instead of (1,)")
            missing = [key for key in INFO_KEYS if key not in info]
            require(not missing, f"{env_id}: info lacks {missing}")
    finally:
        env.close()
    return f"{env_id}: {N_STEPS} steps, observation of shape {tuple(observation.shape)}"


def check_command_line() -> str:
    """The console command stands beside this interpreter, and each of its commands explains itself."""
    from maniskill_tomato.cli.command_table import COMMANDS

    command = Path(sys.executable).parent / "maniskill-tomato"
    for name in ("", *COMMANDS):
        arguments = [str(command), *name.split(), "--help"]
        result = subprocess.run(arguments, capture_output=True, text=True, timeout=120)
        require(
            result.returncode == 0 and result.stdout.startswith("usage: maniskill-tomato"),
            f"`maniskill-tomato {name} --help` exits {result.returncode}: {result.stderr.strip()}",
        )
    return f"maniskill-tomato --help, and that of {len(COMMANDS)} commands"


def main() -> int:
    try:
        print(f"  ok: {check_files()}")
        for env_id in TASK_IDS:
            print(f"  ok: {check_task(env_id)}")
        print(f"  ok: {check_command_line()}")
    except SmokeFailure as failure:
        print(f"  failed: {failure}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
