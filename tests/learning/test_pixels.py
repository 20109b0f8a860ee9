"""Learning from images: what is observed, how it is kept and learned from, and that policies act on it everywhere."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torch import Tensor

from maniskill_tomato import cli
from maniskill_tomato.errors import InvalidInputError, PolicyError
from maniskill_tomato.experiments.rollout import run_episodes
from maniskill_tomato.files import write_tensors
from maniskill_tomato.learning.rl.agent import Agent, make_agent, update
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.export import export_policy
from maniskill_tomato.learning.rl.gymnasium_env import make_gymnasium_env
from maniskill_tomato.learning.rl.presets import TrainConfig, default_preset, get_preset
from maniskill_tomato.learning.rl.random_shift import shifted
from maniskill_tomato.learning.rl.replay import Batch, ReplayBuffer
from maniskill_tomato.learning.rl.trainer import make_training_env, train
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.policies.image_encoder import ImageEncoder
from maniskill_tomato.policies.onnx_policy import OnnxPolicy
from maniskill_tomato.policies.opening import needs_colours, open_policy
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.image_observation import FrameStack
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.making import make_world

GENERAL = "TomatoViewpoint-v1"
GUIDED = "TomatoViewpointGuided-v1"
MODE = "depth+segmentation"
SMALL = (40, 32)


def small(preset: str = "general-pixel-td3", **changes: Any) -> TrainConfig:
    options: dict[str, Any] = {
        "image_size": SMALL,
        "image_features": 8,
        "image_shift": 1,
        "asymmetric_critic": False,
        "actor_hidden": (16,),
        "critic_hidden": (16,),
        "batch_size": 8,
        "buffer_size": 40,
        "num_envs": 2,
        "learning_starts": 16,
        "updates_per_step": 0.5,
        "total_timesteps": 60,
        "checkpoint_every": 20,
    }
    return dataclasses.replace(get_preset(preset), **{**options, **changes})


def space(kinds: str = MODE) -> gym.spaces.Dict:
    layout = ImageLayout.parse(kinds, SMALL)
    assert layout is not None
    state = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    return gym.spaces.Dict({"state": state, **layout.spaces()})


def some(count: int, seed: int = 0) -> dict[str, Tensor]:
    rng = np.random.default_rng(seed)
    return {
        "state": torch.from_numpy(rng.normal(size=(count, 3)).astype(np.float32)),
        "depth": torch.from_numpy(rng.integers(0, 3000, (count, SMALL[1], SMALL[0], 1)).astype(np.int16)),
        "segmentation": torch.from_numpy(rng.integers(0, 7, (count, SMALL[1], SMALL[0], 1)).astype(np.uint8)),
    }


def transitions(count: int, seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.rand(count, 6, generator=generator)
    return Batch(
        some(count, seed),
        numbers[:, :3] * 2 - 1,
        numbers[:, 3],
        some(count, seed + 100),
        (numbers[:, 4] > 0.8).float(),
    )


def agent_of(**changes: Any) -> Agent:
    torch.manual_seed(0)
    return make_agent(small(**changes), 3, 3, privileged_dim=5)


# ------------------------------------------------------------------ images


@pytest.mark.parametrize(
    ("mode", "kinds"),
    [("rgbd", ("rgb", "depth")), ("segmentation+rgb", ("rgb", "segmentation")), ("depth", ("depth",))],
)
def test_observation_modes_are_maniskills_words(mode: str, kinds: tuple[str, ...]) -> None:
    layout = ImageLayout.parse(mode)
    assert layout is not None and layout.kinds == kinds
    assert ImageLayout.parse("state") is None


@pytest.mark.parametrize("mode", ["pixels", "rgb+rgb", "rgbd+depth", "depth+", ""])
def test_other_modes_are_refused_with_what_is_allowed(mode: str) -> None:
    with pytest.raises(InvalidInputError, match="'rgbd'.*'segmentation'"):
        ImageLayout.parse(mode)


@pytest.mark.parametrize("env_id", [GENERAL, GUIDED])
def test_depth_and_roles_of_a_pixel_are_those_of_the_picture_in_its_middle(env_id: str) -> None:
    world = make_world(env_id, 2)
    world.reset(4)
    layout = ImageLayout(kinds=("depth", "segmentation"), width=40, height=30)
    images = world.images(layout)
    camera = layout.intrinsics(world.intrinsics)
    assert math.isclose(camera.fov_y, world.intrinsics.fov_y)
    for i in range(2):
        pose = world.plant_batch.T_world_plant[i]
        picture = world.scene.picture(camera, world.T_w_camera[i], pose, world.T_w_links[i], i)
        expected = np.where(picture.labels == 0, 4.0, np.minimum(picture.depth, 4.0))
        np.testing.assert_allclose(images["depth"][i, ..., 0].numpy(), 1e3 * expected, atol=0.6)
        target = world.plant_batch.plants[i].fruits[int(world.state.target[i])].organ_index
        shown = images["segmentation"][i, ..., 0].numpy() == int(Role.TARGET)
        assert np.array_equal(shown, (picture.labels == target + 2) & (picture.depth < 4.0))


def test_roles_under_a_camera_come_from_segmenter_and_map_and_not_from_the_truth() -> None:
    world = make_world(GENERAL, perception="simulated_segmenter")
    layout = ImageLayout(kinds=("depth", "segmentation"), width=64, height=48)
    shown = 0
    for seed in range(4):
        world.reset(seed)
        for _ in range(6):
            world.step(torch.tensor([[0.5, 0.7, 0.2]]))
            images = world.images(layout)
            role = images["segmentation"][0, ..., 0].numpy()
            perception = world.game.perception  # type: ignore[attr-defined]
            believed = perception.mask(0)
            scale = believed.shape[0] // 48
            middle = believed[scale // 2 :: scale, scale // 2 :: scale]
            assert np.array_equal(role == int(Role.TARGET), middle)
            assert not np.isin(role, [int(Role.STEM), int(Role.OBJECT)]).any()
            measured = perception.last_view(0).measurement.frame.measured_m
            expected = 1e3 * measured[scale // 2 :: scale, scale // 2 :: scale]
            np.testing.assert_allclose(images["depth"][0, ..., 0].numpy(), expected, atol=0.51)
            shown += int(middle.any())
            # Another true target changes nothing that the camera sees.
            world.state.target = (world.state.target + 1) % 3
            assert torch.equal(world.images(layout)["segmentation"], images["segmentation"])
            world.state.target = (world.state.target - 1) % 3
    assert shown > 3


def test_colours_without_a_renderer_are_refused() -> None:
    world = make_world(GUIDED)
    world.reset(0)
    with pytest.raises(InvalidInputError, match="depth\\+segmentation"):
        world.images(ImageLayout(kinds=("rgb",)))


def test_stacked_views_are_the_last_ones_and_begin_with_copies() -> None:
    stack = FrameStack(3)
    views = [{"depth": torch.full((2, 1, 1, 1), float(k))} for k in range(1, 6)]
    found = [stack.push(views[0])["depth"][:, 0, 0].tolist()]
    found += [stack.push(view)["depth"][:, 0, 0].tolist() for view in views[1:4]]
    assert (
        found[0] == [[1.0] * 3] * 2
        and found[1] == [[1.0, 1.0, 2.0]] * 2
        and found[3] == [[2.0, 3.0, 4.0]] * 2
    )
    fresh = stack.push(views[4], torch.tensor([False, True]))["depth"][:, 0, 0].tolist()
    assert fresh == [[3.0, 4.0, 5.0], [5.0] * 3]


def test_shifted_images_are_those_of_opencv_with_repeated_edges() -> None:
    images = some(6, seed=3)
    del images["state"]
    moved = shifted(images, 3, torch.Generator().manual_seed(1))
    seen = set()
    for b in range(6):
        padded = {
            kind: cv2.copyMakeBorder(image[b].numpy(), 3, 3, 3, 3, cv2.BORDER_REPLICATE)
            for kind, image in images.items()
        }
        places = [
            (r, c)
            for r in range(7)
            for c in range(7)
            if np.array_equal(
                padded["depth"][r : r + SMALL[1], c : c + SMALL[0]], moved["depth"][b, ..., 0].numpy()
            )
        ]
        ((row, column),) = places
        seen.add((row, column))
        cut = padded["segmentation"][row : row + SMALL[1], column : column + SMALL[0]]
        assert np.array_equal(cut, moved["segmentation"][b, ..., 0].numpy()), "all images move alike"
    assert len(seen) > 2
    assert all(torch.equal(shifted(images, 0)[kind], images[kind]) for kind in images)


def test_an_encoder_sees_depth_in_metres_and_one_plane_a_role() -> None:
    layout = ImageLayout(kinds=("rgb", "depth", "segmentation"), width=SMALL[0], height=SMALL[1])
    encoder = ImageEncoder(layout, frames=2, features=8)
    images = {name: image.repeat(1, 1, 1, 2) for name, image in some(2).items() if name != "state"}
    images["segmentation"][..., 1] = 0
    images["rgb"] = torch.full((2, SMALL[1], SMALL[0], 6), 255, dtype=torch.uint8)
    planes = encoder.scaled(images)
    assert planes.shape == (2, encoder.planes, SMALL[1], SMALL[0]) == (2, 22, SMALL[1], SMALL[0])
    assert bool((planes[:, :6] == 1.0).all())
    expected = np.minimum(images["depth"][..., 0].numpy() / 1000.0, 2.0) - 1.0
    np.testing.assert_allclose(planes[:, 6].numpy(), expected, atol=1e-6)
    for role in Role:
        assert torch.equal(planes[:, 8 + role].bool(), images["segmentation"][..., 0] == int(role))
    assert bool((planes[:, 15] == 1.0).all()) and not bool(planes[:, 16:].any()), (
        "the other view shows background"
    )
    features = encoder(images).detach()
    assert features.shape == (2, 8) and float(features.abs().max()) < 1.0
    assert not torch.allclose(features[0], features[1])


# ------------------------------------------------------------------ replay


def rows_of(batch: Batch) -> list[tuple[Any, ...]]:
    def flat(value: Any, k: int) -> Any:
        if isinstance(value, dict):
            return tuple(sorted((name, value[name][k].flatten().tolist().__repr__()) for name in value))
        return value[k].tolist()

    return [tuple(flat(v, k) for v in batch if v is not None) for k in range(len(batch.rewards))]


@pytest.mark.parametrize("on_disk", [False, True])
def test_a_buffer_gives_back_the_newest_transitions_in_their_types(tmp_path: Path, on_disk: bool) -> None:
    buffer = ReplayBuffer(6, space(), 3, folder=tmp_path / "replay" if on_disk else None, spare=4)
    parts = [transitions(4, seed) for seed in range(4)]
    for part in parts:
        buffer.add(part)
    kept = {repr(row) for part in (parts[2], parts[3]) for row in rows_of(part)}
    newest = {repr(row) for row in rows_of(parts[3])} | {repr(row) for row in rows_of(parts[2])[2:]}
    drawn = buffer.sample(200, torch.Generator().manual_seed(0))
    assert {repr(row) for row in rows_of(drawn)} == newest and newest < kept
    assert isinstance(drawn.observations, dict)
    assert drawn.observations["depth"].dtype == torch.int16
    assert drawn.observations["segmentation"].dtype == torch.uint8


def test_a_buffer_on_the_disk_goes_on_from_its_checkpoint_though_more_was_written(tmp_path: Path) -> None:
    buffer = ReplayBuffer(6, space(), 3, folder=tmp_path, spare=4)
    for seed in range(3):
        buffer.add(transitions(4, seed))
    saved = buffer.state_dict()
    assert len(json.dumps(saved)) < 200, "a checkpoint does not hold the images"
    wanted = rows_of(buffer.sample(20, torch.Generator().manual_seed(5)))
    buffer.add(transitions(4, 9))  # Lost with the process that is killed now.
    again = ReplayBuffer(6, space(), 3, folder=tmp_path, spare=4)
    again.load_state_dict(saved)
    assert rows_of(again.sample(20, torch.Generator().manual_seed(5))) == wanted
    with pytest.raises(InvalidInputError, match="checkpoint_every"):
        ReplayBuffer(6, space(), 3, folder=tmp_path, spare=5).load_state_dict(saved)


def test_too_large_a_buffer_is_refused_with_the_size_that_fits() -> None:
    row = 4 * (3 + 1 + 1) + 2 * (12 + SMALL[0] * SMALL[1] * 3)
    with pytest.raises(InvalidInputError, match=f"buffer_size to {int(1e6 / row)} or less"):
        ReplayBuffer(1000, space(), 3, largest_gb=1e-3)
    ReplayBuffer(int(1e6 / row), space(), 3, largest_gb=1e-3)


# ------------------------------------------------------------------ updates


def changed(agent: Agent, before: dict[str, Tensor]) -> bool:
    assert agent.encoder is not None
    return any(not torch.equal(v, before[k]) for k, v in agent.encoder.state_dict().items())


@pytest.mark.parametrize("asymmetric", [False, True])
def test_the_encoder_learns_from_the_critics_alone_or_with_blind_critics_from_the_actor(
    asymmetric: bool,
) -> None:
    agent = agent_of(asymmetric_critic=asymmetric, actor_starts=1)
    batch = transitions(8)
    if asymmetric:
        assert isinstance(batch.observations, dict) and isinstance(batch.next_observations, dict)
        privileged = {"privileged": torch.rand(8, 5)}
        batch = batch._replace(
            observations=batch.observations | privileged,
            next_observations=batch.next_observations | privileged,
        )
    assert agent.encoder is not None
    before = {name: value.clone() for name, value in agent.encoder.state_dict().items()}
    critic_only = update(agent, batch, 0, torch.Generator().manual_seed(0))
    assert "actor_loss" not in critic_only and changed(agent, before) is not asymmetric
    before = {name: value.clone() for name, value in agent.encoder.state_dict().items()}
    agent.critic_optimizer.param_groups[0]["lr"] = 0.0
    assert "actor_loss" in update(agent, batch, 2, torch.Generator().manual_seed(0))
    assert changed(agent, before) is asymmetric
    inputs = agent.critics[0].hidden[0].in_features  # type: ignore[union-attr,index]
    assert inputs == 3 + (5 if asymmetric else 8) + 3


def test_critics_learn_to_tell_what_only_an_image_shows() -> None:
    agent = agent_of(gamma=0.0, critic_learning_rate=3e-3, image_shift=2)
    generator = torch.Generator().manual_seed(0)

    def batch(count: int) -> Batch:
        seen = some(count, int(torch.randint(10_000, (), generator=generator)))
        near = torch.rand(count, generator=generator) > 0.5
        seen["depth"] = (
            torch.where(near[:, None, None, None], 400, 1500).short().expand_as(seen["depth"]).clone()
        )
        actions = torch.rand(count, 3, generator=generator) * 2 - 1
        return Batch(seen, actions, near.float(), seen, torch.ones(count))

    for k in range(40):
        update(agent, batch(24), k, generator)
    test = batch(64)
    with torch.no_grad():
        values = agent.critics[0](agent.critic_input(test.observations), test.actions)
    assert float((values - test.rewards).abs().mean()) < 0.15


# ------------------------------------------------------------------ training


@pytest.mark.parametrize("on_disk", [False, True])
def test_a_run_that_stopped_goes_on_bit_for_bit(tmp_path: Path, on_disk: bool) -> None:
    config = small(frame_stack=2, replay_on_disk=on_disk, asymmetric_critic=on_disk)
    train(GENERAL, config, tmp_path / "whole", 3, {}, show_progress=False)
    half = dataclasses.replace(config, total_timesteps=40)
    train(GENERAL, half, tmp_path / "parts", 3, {}, show_progress=False)
    train(GENERAL, config, tmp_path / "parts", 3, {}, show_progress=False, resume=True)
    whole, parts = (load_checkpoint(tmp_path / name / "policy.pt") for name in ("whole", "parts"))
    for part in ("actor", "encoder", "normalizer"):
        for name, value in whole[part].items():
            assert torch.equal(value, parts[part][name]), (part, name)
    assert whole["counters"]["updates"] == parts["counters"]["updates"] > 15


@pytest.mark.slow
def test_the_command_trains_evaluates_and_exports_with_the_pixel_preset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    sizes = [
        "--image-size",
        "40",
        "32",
        "--num-envs",
        "2",
        "--buffer-size",
        "128",
        "--learning-starts",
        "130",
    ]
    cli.main(["train", GENERAL, "--obs-mode", MODE, "--total-timesteps", "140", *sizes, "--out", str(run)])
    config = json.loads((run / "config.json").read_text())["config"]
    assert config["obs_mode"] == MODE and config["buffer_size"] == 128
    assert config["action_scale"] == [1.0, 1.0, 1.0], "the general tasks' preset"
    policy = str(run / "policy.pt")
    out = str(tmp_path / "eval")
    cli.main(
        ["eval", GENERAL, "--policy", policy, "--episodes", "2", "--no-video", "--no-baseline", "--out", out]
    )
    metrics = json.loads((tmp_path / "eval" / "metrics.json").read_text())
    assert metrics["policy"]["kind"] == "TD3"
    cli.main(["export", "--policy", policy, "--out", str(tmp_path / "exported")])
    assert (tmp_path / "exported" / "policy.onnx").is_file()
    capsys.readouterr()


def test_presets_follow_the_task_and_what_is_observed() -> None:
    assert (
        default_preset(GENERAL, MODE) == "general-pixel-td3" and default_preset(GUIDED, MODE) == "pixel-td3"
    )
    assert default_preset(GENERAL, "state") == "general-td3" and default_preset(GUIDED) == "td3"


def test_options_that_do_not_go_together_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="hindsight_targets"):
        small(hindsight_targets=2)
    with pytest.raises(InvalidInputError, match="choose obs_mode"):
        dataclasses.replace(get_preset("td3"), frame_stack=2)
    with pytest.raises(InvalidInputError, match="a part of the observation"):
        small(state_parts=("pose", "memory"))
    with pytest.raises(InvalidInputError, match="state_parts names map"):
        make_training_env(GENERAL, small(state_parts=("pose", "map")), {"layout": ("pose", "target", "time")})


# ------------------------------------------------------------------ policies


def saved(path: Path, env_id: str = GENERAL, mode: str = MODE, frames: int = 1) -> Path:
    torch.manual_seed(1)
    general = env_id == GENERAL
    config = small("general-pixel-td3" if general else "pixel-td3", obs_mode=mode, frame_stack=frames)
    agent = make_agent(config, 11 if general else 9, 3 if general else 6)
    with torch.no_grad():
        agent.actor.output.weight *= 100.0
    bounds = (-torch.ones(3 if general else 6), torch.ones(3 if general else 6))
    counters: dict[str, int | float] = {"steps": 1, "seed": 0}
    write_tensors(
        path, make_checkpoint(agent, env_id, bounds, counters, with_training_state=False, env_options={})
    )
    return path


@pytest.mark.parametrize(("env_id", "frames"), [(GENERAL, 1), (GENERAL, 3), (GUIDED, 2)])
def test_a_policy_of_images_acts_in_its_task_and_exported_it_does_the_same(
    tmp_path: Path, env_id: str, frames: int
) -> None:
    source = saved(tmp_path / "policy.pt", env_id, frames=frames)
    result = export_policy(source, tmp_path / "exported")
    assert result.largest_difference < 1e-4
    assert not needs_colours(source) and not needs_colours(result.model)
    env = make_env(env_id)
    ways = []
    for file in (source, result.model):
        (record,) = run_episodes(env, open_policy(file, env_id=env_id), 1, 11)
        ways.append(record.viewpoints[:4])
    np.testing.assert_allclose(ways[0], ways[1], atol=1e-4)
    assert np.abs(np.diff(ways[0], axis=0)).max() > 1e-2, "it moves"
    # The first move is that of the actor on what the training's environment shows.
    learner = make_training_env(env_id, load_config(source), {})
    observations, _ = learner.reset(seed=[11, 12])
    first = load_actor(source).act({k: v[:1] for k, v in observations.items()})
    env.reset(seed=11)
    env.step(first)
    world: Any = env.unwrapped
    np.testing.assert_allclose(world.state.viewpoint[0].numpy(), ways[0][1], atol=1e-5)


def load_config(path: Path) -> TrainConfig:
    return TrainConfig.from_dict(load_checkpoint(path)["config"])


def test_an_exported_policy_refuses_images_of_another_kind(tmp_path: Path) -> None:
    policy = OnnxPolicy.load(export_policy(saved(tmp_path / "policy.pt"), tmp_path).model)
    seen = {name: value.numpy() for name, value in some(2).items() if name != "state"}
    state = np.zeros((2, 11), np.float32)
    assert policy.act(state, seen).shape == (2, 3)
    with pytest.raises(InvalidInputError, match="observes depth of shape"):
        policy.act(state)
    with pytest.raises(InvalidInputError, match="depth of shape"):
        policy.act(state, {**seen, "depth": seen["depth"][:, :-1]})
    with pytest.raises(InvalidInputError, match="segmentation as uint8, got int64"):
        policy.act(state, {**seen, "segmentation": seen["segmentation"].astype(np.int64)})


def test_an_export_with_other_convolutions_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = saved(tmp_path / "policy.pt")
    forward = ImageEncoder.forward

    def other(self: ImageEncoder, images: Any) -> Tensor:
        return forward(self, images) + 1e-3

    monkeypatch.setattr(ImageEncoder, "forward", other)
    with pytest.raises(PolicyError, match="cannot be exported"):
        export_policy(source, tmp_path / "exported")
    assert not (tmp_path / "exported").exists()


# ------------------------------------------------------------------ other learners


@pytest.mark.parametrize("env_id", TASK_IDS)
@pytest.mark.parametrize("mode", ["state", MODE])
@pytest.mark.filterwarnings("ignore:.*(too low|too high|unwrapped version).*")
def test_every_task_passes_gymnasiums_check(env_id: str, mode: str) -> None:
    env = make_gymnasium_env(env_id, obs_mode=mode, image_size=SMALL)
    check_env(env.unwrapped, skip_render_check=True)
    first, _ = env.reset(seed=5)
    again, _ = env.reset(seed=5)
    assert str(first) == str(again)
    assert env.unwrapped.np_random.integers(1000) == np.random.default_rng(5).integers(1000)
    env.close()


def test_an_option_of_the_simulator_gives_the_same_environment_over_its_shell() -> None:
    plain, simulated = make_gymnasium_env(GUIDED), make_gymnasium_env(GUIDED, motion="kinematic")
    assert plain.observation_space == simulated.observation_space
    for env in (plain, simulated):
        env.reset(seed=3)
    steps = [env.step(np.full(6, 0.1, np.float32)) for env in (plain, simulated)]
    np.testing.assert_allclose(steps[0][0], steps[1][0], atol=1e-5)
    assert steps[0][1] == pytest.approx(steps[1][1], abs=1e-5) and steps[0][2:4] == steps[1][2:4]
    simulated.close()


def test_the_potential_reward_is_refused_where_the_task_has_one_already() -> None:
    env = make_gymnasium_env(GENERAL, reward="potential")
    with pytest.raises(InvalidInputError, match="reward='task'"):
        env.reset(seed=0)


def test_stable_baselines_learns_on_images_with_the_packages_encoder() -> None:
    baselines = pytest.importorskip("stable_baselines3")
    from maniskill_tomato.learning.rl.sb3_images import ImageFeatures

    env = make_gymnasium_env(GUIDED, obs_mode=MODE, image_size=SMALL)
    options = {"features_extractor_class": ImageFeatures, "normalize_images": False, "net_arch": [8]}
    model = baselines.TD3(
        "MultiInputPolicy",
        env,
        buffer_size=60,
        learning_starts=8,
        batch_size=8,
        policy_kwargs=options,
        seed=0,
    )
    encoder = model.critic.features_extractor.encoder
    before = encoder.trunk.weight.detach().clone()
    model.learn(20)
    assert not torch.equal(before, encoder.trunk.weight)
    action, _ = model.predict(env.reset(seed=1)[0], deterministic=True)
    assert action.shape == (6,) and env.action_space.contains(action)
    with pytest.raises(InvalidInputError, match="dictionary of state and images"):
        ImageFeatures(gym.spaces.Dict({"state": gym.spaces.Box(-1, 1, (3,))}))  # type: ignore[arg-type]


@pytest.mark.render
@pytest.mark.parametrize("env_id", [GUIDED, GENERAL])
def test_rendered_images_have_the_roles_and_depths_of_cast_ones(env_id: str) -> None:
    import maniskill_tomato  # noqa: F401
    from maniskill_tomato.tasks.maniskill.image_wrapper import FlattenImageObservationWrapper

    size = {"width": 64, "height": 48}
    env = FlattenImageObservationWrapper(
        gym.make(env_id, obs_mode="rgb+depth+segmentation", sensor_configs=size)
    )
    seen, _ = env.reset(seed=3)
    assert env.observation_space.contains({k: v.numpy() for k, v in seen.items()})
    world: Any = env.unwrapped
    layout = ImageLayout(kinds=("rgb", "depth", "segmentation"), width=64, height=48)
    cast = world.images(layout)
    plant = cast["segmentation"] != int(Role.BACKGROUND)
    same = seen["segmentation"] == cast["segmentation"]
    assert float(same[plant].float().mean()) > 0.97
    shown = {int(r) for r in seen["segmentation"].unique()}
    assert {int(Role.LEAF), int(Role.STEM), int(Role.TARGET)} <= shown | {int(Role.TARGET)}
    near = plant & same
    difference = (seen["depth"].float() - cast["depth"].float()).abs()[near]
    assert float(difference.quantile(0.95)) < 8.0
    assert torch.equal(cast["rgb"], seen["rgb"]), "one camera"
    env.close()


@pytest.mark.render
def test_a_policy_of_colours_trains_and_is_evaluated_in_the_shell(tmp_path: Path) -> None:
    config = small("pixel-td3", obs_mode="rgb", num_envs=1, total_timesteps=30, learning_starts=20)
    train(GUIDED, config, tmp_path / "run", 0, {}, show_progress=False)
    policy = tmp_path / "run" / "policy.pt"
    assert needs_colours(policy)
    cli.main(
        ["eval", GUIDED, "--policy", str(policy), "--episodes", "1", "--no-video", "--no-baseline"]
        + ["--out", str(tmp_path / "eval")]
    )
    assert (tmp_path / "eval" / "metrics.json").is_file()


def test_without_a_renderer_a_policy_of_colours_says_what_it_needs(tmp_path: Path) -> None:
    policy = open_policy(saved(tmp_path / "policy.pt", GUIDED, "rgb"), env_id=GUIDED)
    with pytest.raises(InvalidInputError, match="images with rgb need a renderer"):
        run_episodes(make_env(GUIDED), policy, 1, 0)
