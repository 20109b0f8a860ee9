"""Pictures of the tasks: every observation mode, render modes, segmentation that agrees with the ray cast."""

import math
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.plants.organs import SemanticClass

pytestmark = pytest.mark.render

GUIDED = "TomatoViewpointGuided-v1"
SPARSE = "TomatoViewpointSparse-v1"
SIZE = {"width": 96, "height": 64}


def make(env_id: str, **kwargs: Any) -> Any:
    options: dict[str, Any] = {"num_envs": 1, "sensor_configs": dict(SIZE)}
    return gym.make(env_id, **(options | kwargs))


@pytest.mark.parametrize(
    ("obs_mode", "textures"),
    [
        ("rgb", {"rgb": (64, 96, 3)}),
        ("depth", {"depth": (64, 96, 1)}),
        ("segmentation", {"segmentation": (64, 96, 1)}),
        ("rgbd", {"rgb": (64, 96, 3), "depth": (64, 96, 1)}),
        ("rgb+depth+segmentation", {"rgb": (64, 96, 3), "depth": (64, 96, 1), "segmentation": (64, 96, 1)}),
    ],
)
def test_picture_modes_have_their_textures(obs_mode: str, textures: dict[str, tuple[int, ...]]) -> None:
    env = make(GUIDED, obs_mode=obs_mode)
    obs, _ = env.reset(seed=0)
    assert set(obs["sensor_data"]["d435"]) == set(textures)
    for name, shape in textures.items():
        assert obs["sensor_data"]["d435"][name].shape == (1, *shape)
    assert {"ee_position", "ee_rpy", "target_position"} <= set(obs["extra"])
    assert obs["agent"]["qpos"].shape == (1, 7)
    assert env.observation_space.contains({k: v for k, v in _numpy(obs).items()})
    env.close()


def _numpy(tree: Any) -> Any:
    return {k: _numpy(v) for k, v in tree.items()} if isinstance(tree, dict) else tree.cpu().numpy()


def test_plain_modes_and_pointcloud() -> None:
    for obs_mode in ("state_dict", "none", "pointcloud"):
        env = make(GUIDED, obs_mode=obs_mode)
        obs, _ = env.reset(seed=0)
        if obs_mode == "state_dict":
            assert obs["extra"]["target_position"].shape == (1, 3)
        elif obs_mode == "pointcloud":
            assert obs["pointcloud"]["xyzw"].shape == (1, 64 * 96, 4)
        else:
            assert obs == {}
        env.close()


@pytest.mark.parametrize("env_id", [GUIDED, SPARSE])
def test_visible_fraction_is_the_share_of_the_targets_outline_that_the_picture_shows(env_id: str) -> None:
    env = make(env_id, obs_mode="segmentation", sensor_configs={"width": 320, "height": 240})
    base: Any = env.unwrapped
    seen, present = [], set()
    for seed in range(12):
        obs, info = env.reset(seed=seed)
        ids = obs["sensor_data"]["d435"]["segmentation"]
        outline = outline_area(base, obs["sensor_param"]["d435"])
        shown = int((ids == int(info["target_id"])).sum()) / outline
        # Pixels at the edge are in or out: some 5 % of the few hundred that a fruit covers at this size.
        assert float(info["visible_fraction"]) == pytest.approx(shown, abs=0.08)
        seen.append(shown)
        classes = base.semantic_classes()
        present |= {classes.get(int(i), SemanticClass.BACKGROUND) for i in ids.unique()}
    assert min(seen) == 0.0 and max(seen) > 0.2
    assert {SemanticClass.LEAF, SemanticClass.STEM, SemanticClass.FRUIT_RIPE} <= present
    env.close()


def outline_area(base: Any, params: dict[str, torch.Tensor]) -> float:
    """Area of the target's silhouette in the image plane, a fruit being nearly convex, in [px]."""
    plant = base.plant_batch.plants[0]
    vertices_p = plant.organs[plant.fruits[int(base.target_fruit[0])].organ_index].vertices
    T_world_plant = base.plant_batch.T_world_plant[0].numpy()
    vertices_w = vertices_p @ T_world_plant[:3, :3].T + T_world_plant[:3, 3]
    T_cam_world = params["extrinsic_cv"][0].numpy()
    vertices_c = vertices_w @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    pixels = vertices_c @ params["intrinsic_cv"][0].numpy().T
    hull = cv2.convexHull((pixels[:, :2] / pixels[:, 2:]).astype(np.float32))
    return float(cv2.contourArea(hull))


def test_depth_points_of_the_target_lie_on_the_target() -> None:
    env = make(SPARSE, obs_mode="depth+segmentation", sensor_configs={"width": 320, "height": 240})
    base: Any = env.unwrapped
    found = 0
    env.reset(seed=0)
    for target in base.plant_batch.ripe_fruits[0]:
        env.reset(seed=0, options={"target": target})
        x, y, z = base.target_position_w[0].tolist()
        options = {"target": target, "viewpoint": [x - 0.3, y, z, 0.0, math.pi / 2, 0.0]}
        obs, info = env.reset(seed=0, options=options)
        data, params = obs["sensor_data"]["d435"], obs["sensor_param"]["d435"]
        mask = data["segmentation"][0, ..., 0] == int(info["target_id"])
        if int(mask.sum()) < 20:
            continue
        v, u = torch.nonzero(mask, as_tuple=True)
        z = data["depth"][0, ..., 0][mask].double() / 1000.0
        K = params["intrinsic_cv"][0].double()
        rays = torch.stack(
            [(u + 0.5 - K[0, 2]) / K[0, 0], (v + 0.5 - K[1, 2]) / K[1, 1], torch.ones_like(z)], dim=-1
        )
        points_c = rays * z[:, None]
        T_cam_world = params["extrinsic_cv"][0].double()
        points_w = (points_c - T_cam_world[:3, 3]) @ T_cam_world[:3, :3]
        distance = (points_w - base.target_position_w[0].double()).norm(dim=-1)
        plant = base.plant_batch.plants[0]
        radius = plant.fruits[int(base.target_fruit[0])].radius
        # 1 mm of depth quantisation, and vertices of the mesh lie inside the bounding sphere.
        assert float(distance.median()) < radius + 0.002
        assert float(distance.median()) > 0.7 * radius
        found += 1
    assert found >= 2
    env.close()


@pytest.mark.parametrize("render_mode", ["rgb_array", "sensors", "all"])
def test_render_modes_give_pictures_with_something_in_them(render_mode: str) -> None:
    env = make(GUIDED, obs_mode="state", render_mode=render_mode)
    env.reset(seed=0)
    picture = np.asarray(env.render())
    assert picture.ndim == 4 and picture.shape[-1] == 3 and picture.dtype == np.uint8
    assert picture.std() > 10
    env.close()


def test_rgb_rewards_and_state_rewards_are_the_same() -> None:
    plain, pictured = make(GUIDED, obs_mode="state", render_backend="none"), make(GUIDED, obs_mode="rgb")
    rng = np.random.default_rng(0)
    for seed in range(3):
        plain.reset(seed=seed)
        pictured.reset(seed=seed)
        for _ in range(3):
            action = rng.uniform(-0.1, 0.1, 6).astype(np.float32)
            a, b = plain.step(action), pictured.step(action)
            assert torch.equal(a[1], b[1])
            assert torch.equal(a[4]["target_id"], b[4]["target_id"])
    plain.close()
    pictured.close()


def test_flatten_wrapper_and_video_recording_work(tmp_path: Path) -> None:
    from mani_skill.utils.wrappers.flatten import FlattenRGBDObservationWrapper
    from mani_skill.utils.wrappers.record import RecordEpisode

    env: Any = make(GUIDED, obs_mode="rgb+depth", render_mode="rgb_array")
    env = FlattenRGBDObservationWrapper(env, rgb=True, depth=True, state=True)
    env = RecordEpisode(env, str(tmp_path), save_trajectory=True, save_video=True, max_steps_per_video=3)
    obs, _ = env.reset(seed=0)
    assert obs["rgb"].shape == (1, 64, 96, 3) and obs["depth"].shape == (1, 64, 96, 1)
    for _ in range(3):
        env.step(np.full(6, 0.02, dtype=np.float32))
    env.close()
    videos = list(tmp_path.glob("*.mp4"))
    assert videos and videos[0].stat().st_size > 1000
    assert list(tmp_path.glob("*.h5"))


def test_a_new_plant_at_every_reset_shows_in_the_picture() -> None:
    env = make(GUIDED, obs_mode="rgb", plant={"seed": "train"})
    pictures = [env.reset(seed=s)[0]["sensor_data"]["d435"]["rgb"].clone() for s in (0, 1, 0)]
    assert float((pictures[0].float() - pictures[1].float()).abs().mean()) > 5
    assert int((pictures[0].int() - pictures[2].int()).abs().max()) <= 1
    env.close()


def test_new_plants_are_the_same_with_and_without_a_renderer() -> None:
    plant = {"preset": "three_tomatoes", "seed": "train"}
    plain = make(SPARSE, obs_mode="state", render_backend="none", plant=plant)
    pictured = make(SPARSE, obs_mode="segmentation", plant=plant)
    for seed in (3, 1, 3):
        a, b = plain.reset(seed=seed), pictured.reset(seed=seed)
        assert plain.unwrapped.plant_batch.seeds == pictured.unwrapped.plant_batch.seeds
        assert torch.equal(a[1]["target_id"], b[1]["target_id"])
        torch.testing.assert_close(
            a[0][:, :6], torch.cat([b[0]["extra"]["ee_position"], b[0]["extra"]["ee_rpy"]], -1)
        )
        torch.testing.assert_close(a[1]["visible_fraction"], b[1]["visible_fraction"])
        ids = set(pictured.unwrapped.segmentation_id_map)
        assert set(plain.unwrapped.semantic_classes()) <= ids
        assert plain.unwrapped.semantic_classes() == pictured.unwrapped.semantic_classes()
        name = pictured.unwrapped.segmentation_id_map[int(b[1]["target_id"])].name
        assert "fruit" in name
    plain.close()
    pictured.close()
