"""Demonstrations turned into images by ManiSkill's own tool, and read by its own loader."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from maniskill_tomato.learning.imitation.demonstrations import record_demonstrations
from maniskill_tomato.learning.rl.envs import make_simulated_env
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.sensing.image_layout import ImageLayout

ENV_ID = "TomatoViewpoint-v1"
OBS_MODE = "rgb+depth+segmentation"
REPLAYED = f"trajectory.{OBS_MODE}.pd_look_at.physx_cpu.h5"
LAYOUT = ImageLayout(kinds=("depth", "segmentation"), width=160, height=120)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of the oracle, recorded without a renderer."""
    env: Any = make_simulated_env(ENV_ID)
    oracle = open_policy("oracle", env_id=ENV_ID, ground_truth=env.unwrapped.ground_truth)
    result = record_demonstrations(env, oracle, range(2), tmp_path_factory.mktemp("shown"))
    assert result.recorded == 2
    return result.path


def states_of(episode: Any, step: int) -> dict[str, dict[str, NDArray[Any]]]:
    return {
        group: {name: values[step][None] for name, values in members.items()}
        for group, members in episode["env_states"].items()
    }


def test_the_description_lets_others_make_the_task_with_pictures(recorded: Path) -> None:
    described = json.loads(recorded.with_suffix(".json").read_text())["env_info"]
    assert described["env_kwargs"] == {"obs_mode": "state", "num_envs": 1}
    assert described["env_id"] == f"maniskill_tomato:{ENV_ID}"


def test_the_environment_is_the_same_after_recording(tmp_path: Path) -> None:
    env: Any = make_simulated_env(ENV_ID)
    before = env.unwrapped.spec
    record_demonstrations(env, open_policy("stay", env_id=ENV_ID), range(1), tmp_path)
    assert env.unwrapped.spec is before and before.kwargs["render_backend"] == "none"


@pytest.mark.render
def test_replays_are_images_of_the_recorded_views(recorded: Path) -> None:
    from mani_skill.trajectory.dataset import ManiSkillTrajectoryDataset
    from mani_skill.trajectory.replay_trajectory import Args, main

    main(Args(traj_path=str(recorded), obs_mode=OBS_MODE, save_traj=True))
    data: Any = ManiSkillTrajectoryDataset(str(recorded.with_name(REPLAYED)), success_only=True)
    pictures = data.obs["sensor_data"]["d435"]
    shapes = {name: (picture.shape[1:], picture.dtype) for name, picture in pictures.items()}
    assert shapes == {
        "rgb": ((120, 160, 3), np.uint8),
        "depth": ((120, 160, 1), np.int16),
        "segmentation": ((120, 160, 1), np.int16),
    }
    drawn: Any = gym.make(ENV_ID, obs_mode=OBS_MODE)
    cast: Any = make_simulated_env(ENV_ID)
    actions, row = [], 0
    with h5py.File(recorded) as file:
        for seed in range(2):
            episode: Any = file[f"traj_{seed}"]
            drawn.reset(seed=seed)
            cast.reset(seed=seed)
            actions.append(episode["actions"][()])
            # The loader leaves out an episode's last view.
            for step in range(len(actions[-1])):
                state = states_of(episode, step)
                drawn.unwrapped.set_state_dict(state)
                expected = drawn.unwrapped.get_obs()["sensor_data"]["d435"]
                for name, tolerance in (("rgb", 1), ("depth", 1), ("segmentation", 0)):
                    difference = pictures[name][row].astype(int) - expected[name][0].numpy().astype(int)
                    assert np.abs(difference).max() <= tolerance, name
                # Rays, which know nothing of the renderer, meet plants and arm at the same depths.
                cast.unwrapped.set_state_dict(state)
                images = cast.unwrapped.images(LAYOUT)
                depth = images["depth"][0].numpy().astype(int)
                hit = images["segmentation"][0].numpy() != Role.BACKGROUND
                agree = [(np.abs(shown.astype(int) - depth) <= 5)[hit].mean() for shown in pictures["depth"]]
                # At edges of leaves the next pixel may be met; other views have hardly a depth in common.
                assert agree.pop(row) > 0.98 and max(agree) < 0.5, (row, agree)
                seen = torch.as_tensor(episode["obs"][step][None])
                torch.testing.assert_close(
                    torch.cat([torch.as_tensor(v[row][None]) for v in data.obs["extra"].values()], dim=-1),
                    seen,
                )
                row += 1
    assert row == len(data)
    np.testing.assert_array_equal(data.actions, np.concatenate(actions))
    assert data.success.sum() == 2
    drawn.close()
    cast.close()


@pytest.mark.slow
@pytest.mark.render
@pytest.mark.parametrize("how", [[], ["--use-env-states"]])
def test_maniskills_command_replays_a_file_as_it_is(recorded: Path, tmp_path: Path, how: list[str]) -> None:
    for suffix in (".h5", ".json"):
        (tmp_path / f"trajectory{suffix}").write_bytes(recorded.with_suffix(suffix).read_bytes())
    command = [sys.executable, "-W", "ignore", "-m", "mani_skill.trajectory.replay_trajectory"]
    command += [
        "--traj-path",
        str(tmp_path / "trajectory.h5"),
        "-o",
        OBS_MODE,
        "--save-traj",
        "--count",
        "1",
        *how,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert "1/1=100.00% demos saved" in done.stdout
    with h5py.File(tmp_path / REPLAYED) as file, h5py.File(recorded) as original:
        replayed: Any = file["traj_0"]
        shown: Any = original["traj_0"]
        np.testing.assert_array_equal(replayed["actions"], shown["actions"])
        rgb = replayed["obs/sensor_data/d435/rgb"]
        assert rgb.shape == (len(shown["actions"]) + 1, 120, 160, 3) and rgb[()].std() > 10
