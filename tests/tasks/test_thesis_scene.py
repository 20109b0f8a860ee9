"""The scene of the thesis beside the hidden one: its camera, who uses it, what its exploration meets."""

import json
import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import maniskill_tomato.tasks as tasks
from maniskill_tomato.cli import main
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import ReproductionConfig
from maniskill_tomato.experiments.reproduction import plan_trials, untrained_first_steps
from maniskill_tomato.experiments.variants import experiments, find_variant
from maniskill_tomato.learning.rl.presets import PRESETS, preset_options
from maniskill_tomato.policies.layout import EPSILON_GREEDY_HIGH, EPSILON_GREEDY_LOW
from maniskill_tomato.policies.trained_actor import load_actor
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.sensing.simulated_camera import IMAGE_SIZE, make_camera
from maniskill_tomato.tasks.making import make_world
from maniskill_tomato.tasks.vector_env import make_vector_env
from maniskill_tomato.tasks.world import World

GUIDED, SPARSE = tasks.THESIS_IDS


def angles(camera: CameraIntrinsics) -> tuple[float, float]:
    """Width and height of the picture, in [deg]."""
    return math.degrees(camera.fov_x), math.degrees(camera.fov_y)


def no_colours(env_index: int) -> NDArray[np.uint8]:
    """What a camera without a renderer never asks for."""
    raise AssertionError(env_index)


def what_stands(world: World) -> tuple[float, ...]:
    """Plant and pose."""
    world.reset(0)
    return (*world.plant_batch.seeds, *world.state.plant_pose[0].tolist())


# 2 atan(480 / 640 tan(69.4 / 2)) = 54.9 degrees; the D435 itself keeps its 42.5 degrees of height.
@pytest.mark.parametrize("env_id", tasks.THESIS_IDS)
def test_each_scene_has_its_camera_and_the_hidden_one_is_the_default(env_id: str) -> None:
    worlds: dict[str, World] = {"default": make_world(env_id)}
    worlds |= {scene: make_world(env_id, scene=scene) for scene in ("hidden", "thesis")}
    assert angles(worlds["thesis"].intrinsics) == pytest.approx((69.4, 54.9), abs=0.05)
    assert angles(worlds["hidden"].intrinsics) == pytest.approx((54.8, 42.5), abs=0.05)
    assert worlds["default"].intrinsics == worlds["hidden"].intrinsics
    stands = {name: what_stands(world) for name, world in worlds.items()}
    assert stands["default"] == stands["hidden"] != stands["thesis"]
    assert stands["default"] == pytest.approx(
        (1, 0.85, 0.2, 0.0) if env_id == GUIDED else (4, 0.85, 0.0, 0.0)
    )


def test_a_plant_and_a_pose_can_be_given_in_the_scene_of_the_thesis() -> None:
    world = make_world(GUIDED, scene="thesis", plant={"seed": 5}, plant_pose=(0.7, 0.1, 0.2))
    assert what_stands(world) == pytest.approx((5, 0.7, 0.1, 0.2))
    assert angles(world.intrinsics)[0] == pytest.approx(69.4)


@pytest.mark.parametrize("wrong", ["thesiss", "Hidden", None, 3])
def test_a_mistyped_scene_is_refused_with_what_is_allowed(wrong: Any) -> None:
    makers: tuple[Any, ...] = (make_world, gym.make)
    for make in makers:
        with pytest.raises(InvalidInputError, match=r"scene must be one of 'hidden', 'thesis'; got"):
            make(SPARSE, scene=wrong)


def test_other_tasks_have_no_scene_and_a_task_has_one_already() -> None:
    with pytest.raises(
        InvalidInputError, match="has no scene=, which is an option of TomatoViewpointGuided-v1"
    ):
        gym.make("TomatoViewpoint-v1", scene="thesis")
    task = make_world(GUIDED).task
    with pytest.raises(InvalidInputError, match="leave out scene= or task="):
        make_world(GUIDED, scene="thesis", task=task)


@pytest.mark.parametrize(
    ("sensors", "expected"),
    [
        ({}, (69.4, 54.9)),
        ({"width": 64, "height": 64}, (69.4, 69.4)),
        ({"calibration": "measured"}, (55.2, 42.9)),
        ({"d435": {"calibration": "nominal"}}, (54.8, 42.5)),
    ],
)
def test_maniskills_shell_has_the_camera_of_the_scene_unless_told_otherwise(
    sensors: dict[str, Any], expected: tuple[float, float]
) -> None:
    env: Any = gym.make(
        SPARSE, scene="thesis", obs_mode="state", render_backend="none", sensor_configs=sensors
    )
    try:
        assert angles(env.unwrapped.camera_intrinsics) == pytest.approx(expected, abs=0.05)
        assert env.unwrapped.world.intrinsics == env.unwrapped.camera_intrinsics
    finally:
        env.close()


def test_the_images_that_are_cast_for_a_camera_have_its_angles() -> None:
    world = make_world(GUIDED, scene="thesis", perception="occlusion_model")
    world.reset(0)
    made = make_camera("occlusion_model", world.scene, world.intrinsics, no_colours, calibration="gazebo")
    assert made is not None
    frame = made[0].take(world.T_w_camera, world.plant_batch.T_world_plant, world.T_w_links)[0]
    assert frame is not None
    assert (frame.intrinsics.width, frame.intrinsics.height) == IMAGE_SIZE
    assert angles(frame.intrinsics) == pytest.approx((69.4, 54.9), abs=0.05)


def test_the_presets_of_the_thesis_train_in_its_scene_and_no_others_do(tmp_path: Path) -> None:
    of_thesis = {name for name in PRESETS if preset_options(name, SPARSE) == {"scene": "thesis"}}
    assert of_thesis == {"thesis-guided", "thesis-sparse"}
    assert all(preset_options(name, SPARSE) == {} for name in set(PRESETS) - of_thesis)
    short = ["train", GUIDED, "--preset", "thesis-guided", "--total-episodes", "1"]
    for name, more, options in (
        ("thesis", [], {"scene": "thesis"}),
        ("hidden", ["--scene", "hidden"], {"scene": "hidden"}),
    ):
        run = tmp_path / name
        main([*short, "--out", str(run), *more])
        assert json.loads((run / "config.json").read_text())["env_options"] == options
        assert load_actor(run / "policy.pt").env_options == options
    # A run begun before there were scenes goes on where it began.
    config = json.loads((tmp_path / "thesis/config.json").read_text()) | {"env_options": {}}
    (tmp_path / "old.json").write_text(json.dumps(config))
    main(
        [
            "train",
            "--config",
            str(tmp_path / "old.json"),
            "--total-episodes",
            "1",
            "--out",
            str(tmp_path / "new"),
        ]
    )
    assert load_actor(tmp_path / "new/policy.pt").env_options == {}


def test_a_reproduction_trains_and_judges_in_the_scene_of_the_thesis(tmp_path: Path) -> None:
    for name, experiment in experiments().items():
        config = ReproductionConfig(experiment=name, out=tmp_path, seeds=(0,))
        (trial,) = plan_trials(config, experiment, find_variant(experiment, "exact"))
        assert trial.env_options == {"scene": "thesis"}
        assert len(trial.evaluations) >= 2
        assert all(one.env_options["scene"] == "thesis" for one in trial.evaluations)
        hidden = experiments("hidden")[name]
        assert hidden.env_options == {"scene": "hidden"}
        assert hidden.evaluations[1].env_options["plant_pose"] == [0.8, 0.1, 0.5]
        trained, other = (
            what_stands(make_world(trial.env_id, **one.env_options)) for one in trial.evaluations[:2]
        )
        assert trained != other


def explored_steps(scene: str, episodes: int) -> tuple[float, float]:
    """Mean steps of episodes of Eq. 5-6 alone, and the share of starts that fulfil the task."""
    env = make_vector_env(GUIDED, episodes, arrays="torch", autoreset_mode="Disabled", scene=scene)
    _, info = env.reset(seed=list(range(5000, 5000 + episodes)))
    passing = float(info["success"].float().mean())
    generator = torch.Generator().manual_seed(1)
    low, high = torch.tensor(EPSILON_GREEDY_LOW), torch.tensor(EPSILON_GREEDY_HIGH)
    steps, running = torch.zeros(episodes), torch.ones(episodes, dtype=torch.bool)
    for _ in range(30):
        info = env.step(low + (high - low) * torch.rand(episodes, 6, generator=generator))[4]
        steps += running
        running &= ~info["success"]
    return float(steps.mean()), passing


def test_random_actions_take_the_steps_of_the_thesis_in_its_scene_alone() -> None:
    # 1278 steps in 240 episodes are 5.3. The steps of one scatter by 10, so that the mean of 1000 does by 0.3.
    steps, passing = explored_steps("thesis", 1000)
    assert steps == pytest.approx(5.3, abs=1.0)
    assert passing == pytest.approx(0.625, abs=0.06)
    steps, passing = explored_steps("hidden", 100)
    assert steps > 25.0 and passing == 0.0


@pytest.mark.parametrize("scene", ["hidden", "thesis"])
def test_a_pose_out_of_reach_by_a_centimetre_is_outside_the_sparse_tasks_workspace(scene: str) -> None:
    env = make_vector_env(SPARSE, arrays="torch", autoreset_mode="Disabled", scene=scene)
    env.reset(seed=0, options={"viewpoint": [0.55, 0.0, 0.6, 0.0, math.pi / 2, 0.0]})
    # The wrist is 0.126 m behind the flange and 0.82 m from the shoulder (0, 0, 0.36) at full reach.
    limit = math.sqrt(0.82**2 - (0.6 - 0.36) ** 2) + 0.126
    _, _, terminated, _, info = env.step(torch.tensor([[limit + 0.01 - 0.55, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    assert bool(terminated) and bool(info["fail"]) and int(info["reachability"]) == Reach.UNREACHABLE


def test_most_untrained_actors_leave_the_sparse_tasks_workspace_at_once() -> None:
    share = untrained_first_steps(SPARSE, PRESETS["thesis-sparse"], 60, {"scene": "thesis"})[
        "unreachable_share"
    ]
    assert 0.75 < share < 0.97
