"""Tasks of somebody else's: own reward, starts and success, in worlds and in ManiSkill's shell alike."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from maniskill_tomato import extension_points, task_registry
from maniskill_tomato.cli import main
from maniskill_tomato.errors import CheckpointError, InvalidInputError, PolicyError
from maniskill_tomato.experiments.configs import EvaluationConfig
from maniskill_tomato.experiments.evaluation import evaluate, evaluate_run
from maniskill_tomato.experiments.training_runs import Run, load_run
from maniskill_tomato.learning.rl.export import export_policy
from maniskill_tomato.learning.rl.presets import PRESETS, default_preset
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.learning.rl.trainer import train
from maniskill_tomato.plants.episode_list import load_episodes, write_episodes
from maniskill_tomato.policies.layout import has_belief
from maniskill_tomato.policies.onnx_policy import OnnxPolicy
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.trained_actor import load_actor
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.tasks import register_task
from maniskill_tomato.tasks.making import make_world, option_names
from maniskill_tomato.tasks.own_rules import Moved

GUIDED, GENERAL, ROW = "TomatoViewpointGuided-v1", "TomatoViewpoint-v1", "TomatoViewpointRow-v1"
BELOW = "TomatoFromBelow-v1"
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers is gone after it."""
    monkeypatch.setattr(task_registry, "_registered", dict(task_registry._registered))
    known = set(gym.registry)
    yield
    for env_id in set(gym.registry) - known:
        del gym.registry[env_id]


def height(moved: Moved) -> torch.Tensor:
    """The flange's height and the gain, so that a wrong tensor shows."""
    return moved.viewpoint[:, 2] + 10.0 * (moved.visible_fraction - moved.previous_fraction)


def beside(rng: np.random.RandomState, count: int, target: np.ndarray) -> np.ndarray:
    low = (-0.05, -0.05, 0.7, 0.0, 1.5, 0.0)
    return rng.uniform(low, (0.05, 0.05, 0.8, 0.0, 1.7, 0.2), (count, 6))


def test_a_reward_of_ones_own_is_the_reward_of_every_move_in_both_shells() -> None:
    register_task("TomatoHeight-v1", GUIDED, reward=height, largest_reward=12.0, starts=beside)
    vector: Any = gym.make_vec("TomatoHeight-v1", num_envs=2)
    single: Any = gym.make("TomatoHeight-v1", obs_mode="state")
    scaled: Any = gym.make("TomatoHeight-v1", obs_mode="state", reward_mode="normalized_dense")
    observation, info = vector.reset(seed=[5, 6])
    assert (np.abs(observation[:, :2]) <= 0.05).all() and (observation[:, 2] >= 0.7).all()
    first, _ = single.reset(seed=5)
    scaled.reset(seed=5)
    np.testing.assert_allclose(first[0].numpy(), observation[0], atol=1e-6)
    rng = np.random.default_rng(0)
    for _ in range(3):
        actions = rng.uniform(-0.1, 0.1, (2, 6)).astype(np.float32)
        before = info["visible_fraction"]
        observation, reward, _, _, info = vector.step(actions)
        by_hand = observation[:, 2] + 10.0 * (info["visible_fraction"] - before)
        np.testing.assert_allclose(reward, by_hand, atol=1e-5)
        np.testing.assert_allclose(single.step(actions[0])[1].numpy(), reward[:1], atol=1e-5)
        np.testing.assert_allclose(scaled.step(actions[0])[1].numpy(), reward[:1] / 12.0, atol=1e-6)


def test_hindsight_asks_the_same_reward_about_the_other_tomatoes() -> None:
    settings = {"outside_workspace": "home"}
    register_task("TomatoHeight-v1", "TomatoViewpointSparse-v1", reward=height, settings=settings)
    env: Any = gym.make_vec("TomatoHeight-v1", num_envs=2, other_targets=2)
    _, info = env.reset(seed=1)
    for _ in range(3):
        before = info["other_visible_fraction"]
        observation, _, terminated, _, info = env.step(np.full((2, 6), 0.05, np.float32))
        assert not terminated.any()
        by_hand = observation[:, 2:3] + 10.0 * (info["other_visible_fraction"] - before)
        np.testing.assert_allclose(info["other_reward"], by_hand, atol=1e-5)


def test_a_success_of_ones_own_ends_the_episode_and_settings_give_way_to_options() -> None:
    register_task(
        "TomatoAnyView-v1",
        GUIDED,
        settings={"plant": {"seed": 3}, "outside_workspace": "end", "rays_per_side": 8},
        success=lambda moved: moved.viewpoint[:, 2] < 0.9,
        max_episode_steps=4,
    )
    world = make_world("TomatoAnyView-v1")
    assert world.plant_batch.spec.seed == 3 and world.task.outside_workspace == "end"
    assert make_world("TomatoAnyView-v1", plant={"seed": 5}).plant_batch.spec.seed == 5
    env: Any = gym.make("TomatoAnyView-v1", obs_mode="state")
    _, info = env.reset(seed=0, options={"viewpoint": (0.1, -0.1, 0.95, 0.0, 1.7, 0.3)})
    assert not info["success"]
    for move, height_m in enumerate((0.93, 0.91, 0.89)):
        _, _, terminated, truncated, info = env.step(np.array([0, 0, -0.02, 0, 0, 0], np.float32))
        assert bool(info["success"]) == bool(terminated) == (height_m < 0.9) and not truncated, move
    env.reset(seed=0, options={"viewpoint": (0.1, -0.1, 0.95, 0.0, 1.7, 0.3)})
    ended = [bool(env.step(np.zeros(6, np.float32))[3]) for _ in range(4)]
    assert ended == [False, False, False, True]
    short: Any = gym.make("TomatoAnyView-v1", obs_mode="state", max_episode_steps=2)
    short.reset(seed=0, options={"viewpoint": (0.1, -0.1, 0.95, 0.0, 1.7, 0.3)})
    assert [bool(short.step(np.zeros(6, np.float32))[3]) for _ in range(2)] == [False, True]


@pytest.mark.usefixtures("extras")
def test_the_examples_task_starts_below_and_pays_for_nearness() -> None:
    world = make_world(BELOW, 2)
    world.reset([1, 2])
    below = (world.T_w_camera[:, :3, 3] - world.target_position_w).numpy()
    low, high = np.array((-0.6, -0.3, -0.4)), np.array((-0.3, 0.3, -0.15))
    assert (below >= low - 1e-4).all() and (below <= high + 1e-4).all()
    assert bool((world.state.visible_fraction < 0.3).all())
    before = world.state.visible_fraction.clone()
    world.step(np.array([[0.0, 0.5, 0.5], [0.3, 0.3, 0.3]], np.float32))
    info = world.info()
    distance = (world.T_w_camera[:, :3, 3] - world.target_position_w).norm(dim=-1)
    success = (info["visible_fraction"] > 0.7) & (distance < 0.4)
    torch.testing.assert_close(info["success"], success)
    by_hand = info["visible_fraction"] - before + success.float() - 0.1 * (distance - 0.4).clamp(min=0.0)
    torch.testing.assert_close(world.reward(info), by_hand, atol=1e-5, rtol=0.0)
    assert has_belief(BELOW) and default_preset(BELOW) == "general-td3"
    assert find_task(BELOW) is find_task("tomato_extras.from_below:TASK")


@pytest.fixture
def trained(extras: Path, tmp_path: Path) -> Path:
    """The policy of a short training on the example's task."""
    config = {"total_timesteps": 24, "learning_starts": 12, "batch_size": 8}
    values = {**PRESETS["general-td3"].to_dict(), **config}
    return train(
        BELOW, TrainConfig.from_dict(values), tmp_path / "run", 0, {}, show_progress=False
    ).policy_path


def test_a_policy_keeps_the_id_that_it_was_trained_on(trained: Path, tmp_path: Path) -> None:
    assert load_actor(trained).env_id == BELOW
    assert json.loads((tmp_path / "run" / "config.json").read_text())["env_id"] == BELOW
    with pytest.raises(CheckpointError, match=f"was trained on {BELOW}, not on {GENERAL}"):
        load_actor(trained, env_id=GENERAL)
    for name in (BELOW, "tomato_extras.from_below:TASK"):
        result = evaluate(
            EvaluationConfig(
                env_id=name,
                policy=str(trained),
                episodes=2,
                seed=3,
                out=tmp_path / "eval",
                baseline=False,
                video=False,
                show_progress=False,
            )
        )
        assert result.metrics["episodes"] == 2 and result.metrics["env_id"] == name


def test_a_policy_whose_task_is_missing_says_so(
    trained: Path,
    extras: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    export_policy(trained, tmp_path / "export")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(extras)])
    monkeypatch.delitem(task_registry._registered, BELOW)
    missing = f"the task {BELOW} is not known here: is the package that has it installed"
    with pytest.raises(PolicyError, match=missing):
        export_policy(trained, tmp_path / "again")
    with pytest.raises(PolicyError, match=missing):
        OnnxPolicy.load(tmp_path / "export" / "policy.onnx")
    for command in (["eval", BELOW, "--policy", str(trained)], ["train", "--resume", str(trained.parent)]):
        with pytest.raises(SystemExit):
            main(command)
        assert task_registry.ELSEWHERE in capsys.readouterr().err


def test_no_module_is_imported_because_a_file_names_it(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "planted.py").write_text("raise SystemExit('the module ran')\n")
    monkeypatch.chdir(tmp_path)
    content = torch.load(trained, weights_only=True)
    torch.save({**content, "env_id": "planted:run"}, tmp_path / "policy.pt")
    with pytest.raises(CheckpointError, match=f"was trained on planted:run, not on {GENERAL}"):
        load_actor(tmp_path / "policy.pt", env_id=GENERAL)
    open_policy(tmp_path / "policy.pt")
    config = tmp_path / "run" / "config.json"
    config.write_text(config.read_text().replace(BELOW, "planted:run"))
    for command in (["train", "--resume", str(tmp_path / "run")], ["train", "--config", str(config)]):
        with pytest.raises(SystemExit) as end:
            main(command)
        assert end.value.code == 2
        assert "is not imported because a file names it" in capsys.readouterr().err
    with pytest.raises(InvalidInputError, match="is not imported because a file names it"):
        evaluate_run(load_run(tmp_path / "run"), 1, 0)
    assert "planted" not in sys.modules


def test_no_plants_are_imported_because_a_file_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "planted_pots.py").write_text("raise SystemExit('the module ran')\n")
    monkeypatch.chdir(tmp_path)
    plant = {"generator": "planted_pots:grow"}
    written = {"env_id": GUIDED, "seed": 0, "config": {}, "env_options": {"plant": plant}}
    (tmp_path / "config.json").write_text(json.dumps(written))
    (tmp_path / "policy.pt").write_bytes(b"")
    (tmp_path / "short.toml").write_text(f'env_id = "{GUIDED}"\n[env_options]\nplant = "planted_pots:grow"\n')
    for command in (["train", "--resume", "."], ["train", "--config", "short.toml", "--out", "new"]):
        with pytest.raises(SystemExit) as end:
            main(command)
        assert end.value.code == 2
        error = " ".join(capsys.readouterr().err.split())
        assert "planted_pots:grow, a module that is not imported because a file names it" in error
        assert "name it with --plant planted_pots:grow, or give it an entry point" in error
    run = Run(
        path=tmp_path,
        env_id=GUIDED,
        seed=0,
        config={"env_options": {"plant": plant}},
        episodes={},
        clock=None,
        metrics=None,
    )
    with pytest.raises(InvalidInputError, match="eval TomatoViewpointGuided-v1 .*--plant planted_pots:grow"):
        evaluate_run(run, 1, 0)
    listed = tmp_path / "listed.json"
    write_episodes(listed, load_episodes("held_out")[:1], plant)
    with pytest.raises(InvalidInputError, match="listed.json names the plant generator planted_pots:grow"):
        make_world(GENERAL, 1, episodes=str(listed))
    assert "planted_pots" not in sys.modules


@pytest.mark.usefixtures("extras")
def test_a_run_on_plants_of_a_module_goes_on_where_the_command_names_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, out = "tomato_extras.potted_plant:potted_plant", str(tmp_path / "run")
    few = [
        "--num-envs",
        "1",
        "--total-timesteps",
        "10",
        "--learning-starts",
        "8",
        "--batch-size",
        "8",
        "--out",
        out,
    ]
    main(["train", "--plant", name, GUIDED, *few])
    extension_points._loaded.clear()  # As in a process of its own.
    with pytest.raises(SystemExit):
        main(["train", "--resume", out, "--total-timesteps", "14"])
    assert f"name it with --plant {name}" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(SystemExit):
        main(["train", "--resume", out, "--total-timesteps", "14", "--plant", "potted"])
    assert "cannot take --plant" in capsys.readouterr().err
    main(["train", "--resume", out, "--total-timesteps", "14", "--plant", name])
    actor = load_actor(tmp_path / "run" / "policy.pt")
    assert actor.counters["steps"] == 14 and actor.env_options == {"plant": {"generator": name}}


def test_the_benchmark_draws_the_episodes_of_another_task(trained: Path, tmp_path: Path) -> None:
    out = tmp_path / "benchmark"
    command = ["benchmark", "--env-id", BELOW, "--policies", f"spiral,own={trained}", "--episodes", "2"]
    main([*command, "--jobs", "1", "--no-pictures", "--out", str(out)])
    rows = json.loads((out / "benchmark.json").read_text())
    assert [(row["policy"], row["episodes"]) for row in rows] == [("spiral", 2), ("own", 2)]
    details = json.loads((out / "benchmark_details.json").read_text())
    assert details["horizon"] == 15
    for wrong in (["--sweeps", "depth"], ["--env-id", ROW]):
        with pytest.raises(SystemExit):
            main([*command, *wrong, "--jobs", "1", "--out", str(tmp_path / "other")])


def test_gymnasium_knows_an_installed_task_by_name_alone(extras_site: Path, tmp_path: Path) -> None:
    code = (
        "import sys, gymnasium as gym, maniskill_tomato\n"
        f"assert '{BELOW}' in gym.registry and 'tomato_extras' not in sys.modules\n"
        f"env = gym.make('{BELOW}', obs_mode='state')\n"
        "observation, info = env.reset(seed=1)\n"
        "assert tuple(observation.shape) == (1, 786), observation.shape\n"
        "assert 'tomato_extras.from_below' in sys.modules\n"
        "assert env._max_episode_steps == 15\n"
        f"assert gym.spec('{BELOW}').max_episode_steps == 15\n"
        "from mani_skill.utils.registration import REGISTERED_ENVS\n"
        f"assert REGISTERED_ENVS['{BELOW}'].cls is type(env.unwrapped)\n"
    )
    paths = os.pathsep.join((str(ROOT), str(extras_site)))
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": paths},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr


def test_a_task_of_a_package_that_is_not_here_is_refused_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["eval", "SomebodyElses-v3"])
    assert task_registry.ELSEWHERE in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["train", "TomatoViewpontGuided-v1"])
    assert "did you mean 'TomatoViewpointGuided-v1'?" in capsys.readouterr().err
    with pytest.raises(InvalidInputError, match="'not_here_at_all:TASK' cannot be loaded: No module"):
        find_task("not_here_at_all:TASK")
    (tmp_path / "odd_task.py").write_text("TASK = 3\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidInputError, match="must be what register_task returned.*got int"):
        find_task("odd_task:TASK")


def test_wrong_rules_and_settings_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    register_task("Flat-v1", GUIDED, reward=lambda moved: moved.qpos)
    world = make_world("Flat-v1", 2)
    world.reset(0)
    with pytest.raises(
        InvalidInputError, match=r"reward of Flat-v1 must .* shape \(2,\).*got one of shape \(2, 7\)"
    ):
        world.reward()
    with pytest.raises(InvalidInputError, match="reward must be a function; got 3"):
        register_task("Flat-v1", GUIDED, reward=3)  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="no field 'generater'; .*did you mean 'generator'"):
        make_world(GUIDED, plant={"generater": "pots"})
    register_task("Torn-v1", GUIDED, reward=lambda moved: 1.0 / torch.arange(float(len(moved.qpos))))
    world = make_world("Torn-v1", 2)
    world.reset(0)
    with pytest.raises(InvalidInputError, match="reward of Torn-v1 must be finite; got inf in 1 of 2 env"):
        world.reward()
    register_task("Soft-v1", GUIDED, success=lambda moved: moved.visible_fraction)
    with pytest.raises(InvalidInputError, match="success of Soft-v1 must return a tensor of bool"):
        make_world("Soft-v1").reset(0)
    register_task("Flat-v1", GUIDED, starts=lambda rng, count, target: np.zeros((count, 3)))
    with pytest.raises(
        InvalidInputError, match=r"starts of Flat-v1 must be finite numbers of shape \(16, 6\)"
    ):
        make_world("Flat-v1").reset(0)
    register_task("Flat-v1", GUIDED, starts=lambda rng, count, target: np.full((count, 6), 9.0))
    with pytest.raises(InvalidInputError, match="the starts of Flat-v1 lie outside the arm's workspace"):
        make_world("Flat-v1").reset(0)
    register_task("Flat-v1", GENERAL, settings={"step_csot": 0.1})
    with pytest.raises(InvalidInputError, match="'step_csot'.*did you mean 'step_cost'"):
        make_world("Flat-v1")
    with pytest.raises(InvalidInputError, match="did you mean 'TomatoViewpoint-v1'"):
        register_task("Flat-v1", "TomatoViewpont-v1")
    with pytest.raises(InvalidInputError, match="is a task of this package"):
        register_task(GUIDED, GUIDED)
    with pytest.raises(InvalidInputError, match="all targets seen"):
        register_task("Flat-v1", ROW, success=lambda moved: moved.visible_fraction > 0.5)
    assert option_names("Flat-v1") == option_names(GENERAL)


def test_an_id_that_gymnasium_does_not_take_is_refused_and_leaves_nothing() -> None:
    gym.register("Unversioned", entry_point="somewhere:make")
    try:
        with pytest.raises(InvalidInputError, match="cannot register Unversioned-v1: .*already exists"):
            register_task("Unversioned-v1", GENERAL)
        with pytest.raises(InvalidInputError, match="cannot register not an ID"):
            register_task("not an ID", GENERAL)
        for name in ("Unversioned-v1", "not an ID"):
            assert name not in gym.registry
            with pytest.raises(InvalidInputError):
                find_task(name)
    finally:
        del gym.registry["Unversioned"]


def test_a_row_pays_a_reward_of_ones_own() -> None:
    register_task("PaidRow-v1", ROW, reward=lambda moved: moved.info["target_done"].float() - 0.5)
    world = make_world("PaidRow-v1")
    world.reset(2)
    world.step(np.zeros((1, 3), np.float32))
    assert float(world.reward()) == float(world.info()["target_done"]) - 0.5


def test_an_episode_taken_up_again_earns_the_same() -> None:
    register_task("TomatoHeight-v1", GUIDED, reward=height)
    world, again = make_world("TomatoHeight-v1"), make_world("TomatoHeight-v1")
    world.reset(3)
    action = np.full((1, 6), 0.04, np.float32)
    world.step(action)
    again.restore(world.save())
    world.step(action)
    again.step(action)
    torch.testing.assert_close(world.reward(), again.reward())
