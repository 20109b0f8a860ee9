"""The general task with everything from the camera image."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.inspection import STALE_AFTER
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.simulated_camera import IMAGE_SIZE, SimulatedCamera
from maniskill_tomato.tasks.making import make_world


def make(**options: Any) -> Any:
    return gym.make(
        "TomatoViewpoint-v1", episodes="validation", obs_mode="state", render_backend="none", **options
    ).unwrapped


def test_what_the_camera_measures_is_near_the_truth() -> None:
    env = make(perception="occlusion_model")
    measured, true, offsets = [], [], []
    for seed in range(4):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        info: dict[str, Any] = {}
        for _ in range(6):
            action = torch.as_tensor(rng.uniform(-1, 1, 3), dtype=torch.float32)
            *_, info = env.step(action)
            if not bool(info["target_named"][0]):
                continue
            measured.append(float(info["told_visible_fraction"][0]))
            true.append(float(info["true_visible_fraction"][0]))
        if bool(info["target_named"][0]) and max(measured[-5:], default=0.0) > 0.2:
            # A target that was seen as well as that has been located.
            offsets.append(float((env.belief.target_position - env.target_position_w).norm()))
    errors = np.abs(np.array(measured) - np.array(true))
    assert max(true) > 0.3, "the views must not all be blind"
    assert errors.mean() < 0.1
    assert len(offsets) >= 2 and np.median(offsets) < 0.015
    env.close()


def test_the_same_seed_measures_the_same() -> None:
    runs = []
    for _ in range(2):
        env = make(perception="occlusion_model")
        observation, _ = env.reset(seed=4)
        after, reward, *_ = env.step(torch.tensor([0.5, 0.3, 0.1]))
        runs.append((observation, after, reward))
        env.close()
    for a, b in zip(*runs, strict=True):
        assert torch.equal(a, b)


def test_with_a_map_an_unseen_target_is_known_to_the_maps_noise() -> None:
    env: Any = gym.make(
        "TomatoViewpoint-v1",
        perception="occlusion_model",
        target="map",
        map_noise=0.02,
        start_visibility=(0.0, 0.001),
        obs_mode="state",
        render_backend="none",
    ).unwrapped
    offsets = []
    for seed in range(5):
        env.reset(seed=seed)
        offsets.append(env.world.state.position_error[0].clone().numpy())
    # 15 draws: the standard deviation is known to 18 %, three times which is 55 %.
    assert np.std(offsets) == pytest.approx(0.02, rel=0.55)
    env.close()


def test_a_target_is_named_when_a_track_holds_its_pixels_and_then_measured_near_the_truth() -> None:
    env = make(perception="occlusion_model")
    named = []
    for seed in range(6):
        env.reset(seed=seed)
        for _ in range(4):
            *_, info = env.step(torch.tensor([0.6, 0.4, 0.2]))
            if float(info["visible_fraction"][0]) > 0.2:
                assert bool(info["target_named"][0])
                assert int(info["chosen_fruit"][0]) == int(env.target_fruit[0])
                named.append(float((env.belief.target_position - env.target_position_w).norm()))
                break
    assert len(named) >= 2 and np.median(named) < 0.015
    env.close()


def test_a_robot_that_chooses_is_judged_by_the_fruit_that_it_chose() -> None:
    env = make(perception="occlusion_model", target="any")
    chosen = 0
    for seed in range(4):
        env.reset(seed=seed)
        *_, info = env.step(torch.tensor([0.5, 0.3, 0.0]))
        if bool(info["target_named"][0]) and int(info["chosen_fruit"][0]) >= 0:
            chosen += 1
            assert int(info["chosen_fruit"][0]) == int(env.target_fruit[0])
            true, of_chosen = (info[f"{k}_visible_fraction"][0] for k in ("true", "chosen"))
            assert float(true) == float(of_chosen)
    assert chosen >= 2
    env.close()


def test_a_chosen_fruit_of_which_no_view_shows_more_is_given_up_for_another_one() -> None:
    world, again = (
        make_world("TomatoViewpoint-v1", episodes="validation", perception="occlusion_model", target="any")
        for _ in range(2)
    )
    world.reset([0])
    targets, beliefs = [], []
    for _ in range(STALE_AFTER + 2):
        world.step(torch.zeros(1, 3))
        targets.append(int(world.state.target[0]))
        beliefs.append(world.belief.target_position[0].clone())
    # The first move's view is compared with nothing; the six after it show no more.
    first, second = targets[0], targets[-1]
    assert targets == [first] * STALE_AFTER + [second] * 2 and first != second
    for fruit, belief in ((first, beliefs[0]), (second, beliefs[-1])):
        assert float((belief - world.fruit_position_w(0, fruit)).norm()) < 0.02
    again.restore(world.save())
    assert torch.equal(again.belief.target_position[0], beliefs[-1])


def test_success_goes_by_the_lower_bound_and_the_policy_is_told_the_estimate() -> None:
    env = make(perception="occlusion_model")
    checked = 0
    for seed in range(4):
        env.reset(seed=seed)
        for _ in range(4):
            *_, info = env.step(torch.tensor([0.6, 0.3, 0.3]))
            told, sure = float(info["told_visible_fraction"][0]), float(info["visible_fraction"][0])
            if told > 0.0:
                assert sure < told == pytest.approx(float(env.belief.visible_fraction[0]))
                assert bool(info["success"][0]) == (sure > env.task.full_visibility)
                checked += 1
    assert checked >= 4
    env.close()


@pytest.mark.parametrize("association", ["map", "truth"])
def test_an_episode_that_is_taken_up_again_knows_what_it_knew(association: str) -> None:
    world = make_world(
        "TomatoViewpoint-v1", episodes="validation", perception="occlusion_model", association=association
    )
    actions = [
        torch.tensor([[0.5, 0.3, 0.1]]),
        torch.tensor([[-0.4, 0.5, 0.2]]),
        torch.tensor([[0.2, 0.2, 0.4]]),
    ]
    world.reset(3)
    for action in actions[:2]:
        world.step(action)
    saved = world.save()
    world.step(actions[2])
    expected = world.observation().clone()
    world.restore(saved)
    world.step(actions[2])
    torch.testing.assert_close(world.observation(), expected, rtol=0.0, atol=1e-6)


def test_reward_goes_by_what_is_measured() -> None:
    env = make(perception="occlusion_model")
    env.reset(seed=2)
    _, reward, _, _, info = env.step(torch.tensor([1.0, 0.0, 0.0]))
    expected = float(info["visible_fraction_gain"][0]) - env.task.step_cost
    expected += env.task.success_reward * float(info["success"][0])
    expected -= env.task.contact_penalty * float(info["plant_contact"][0])
    assert float(reward[0]) == pytest.approx(expected, abs=1e-5)
    env.close()


@pytest.mark.parametrize(
    "options",
    [{"perception": "eyes"}, {"perception": "occlusion_model", "sensor_noise": {"depth_noise": 1.0}}],
)
def test_options_that_make_no_sense_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match="perception"):
        make(**options)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"target": "hint"}, "track.*map.*any"),
        ({"association": "luck"}, "map.*truth"),
        ({"target": "map", "map_noise": -0.1}, "map_noise must be"),
        ({"map_noise": 0.01}, "target='map'"),
    ],
)
def test_unknown_ways_to_name_a_target_are_refused_with_what_is_allowed(
    options: dict[str, Any], told: str
) -> None:
    with pytest.raises(InvalidInputError, match=told):
        make_world("TomatoViewpoint-v1", perception="occlusion_model", **options)
    with pytest.raises(InvalidInputError, match="through a camera"):
        make_world("TomatoViewpoint-v1", **options)


@pytest.mark.parametrize("option", [{"target": "any"}, {"map_noise": 0.01}])
def test_nobody_names_the_targets_of_a_row(option: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match="chooses its targets itself"):
        make_world("TomatoViewpointRow-v1", perception="occlusion_model", **option)


def test_one_rendering_serves_all_environments_of_a_look() -> None:
    asked = []

    def render(qpos: torch.Tensor) -> np.ndarray[Any, np.dtype[np.uint8]]:
        asked.append(qpos.clone())
        return np.zeros((3, 120, 160, 3), dtype=np.uint8)

    intrinsics = color_intrinsics(160, 120)
    world = make_world(
        "TomatoViewpoint-v1", 3, perception="thesis_model", pictures=render, intrinsics=intrinsics
    )
    world.reset(seed=0)
    before = len(asked)
    for k in range(2):
        world.step(torch.full((3, 3), 0.3))
        assert len(asked) == before + 1 + k
        assert torch.equal(asked[-1], world.qpos)


@pytest.mark.render
@pytest.mark.parametrize("perception", ["thesis_model", "improved_model", "segmenter"])
def test_rendered_perceptions_run_and_their_pictures_lie_on_the_cast_labels(perception: str) -> None:
    env = gym.make(
        "TomatoViewpoint-v1",
        episodes="validation",
        obs_mode="state",
        perception=perception,
        sensor_configs={"width": 320, "height": 240},
    ).unwrapped
    task: Any = env
    task.reset(seed=1)
    *_, info = task.step(torch.tensor([0.0, 0.6, 0.3]))
    assert 0.0 <= float(info["visible_fraction"][0]) <= 1.0
    assert set(info) >= {"true_visible_fraction", "true_success"}
    picture = task._wrist_pictures(task.qpos)[0].astype(int)
    assert picture.shape == (240, 320, 3)
    T_w_links = link_transforms(task.agent.robot.get_qpos())
    images = task.world.scene.image(
        task.camera_intrinsics,
        task.world.camera_poses(T_w_links),
        task.target_fruit,
        task.plant_batch.T_world_plant,
        T_w_links,
    )
    target = (images.role[0] == int(Role.TARGET)).numpy()
    if np.count_nonzero(target) > 20:
        red, green, _ = picture[target].T
        assert np.median(red - green) > 30
    # Leaves and stems are green where rays meet the plant.
    plant = torch.isin(
        images.role[0], torch.tensor([Role.STEM, Role.LEAF, Role.OTHER_FRUIT], dtype=torch.uint8)
    ).numpy()
    nothing = (images.role[0] == int(Role.BACKGROUND)).numpy()
    colourful = picture.max(-1) - picture.min(-1)
    assert np.median(colourful[plant]) > 2 * np.median(colourful[nothing])
    env.close()


class Eye:
    """A simulated camera that looks from where an environment's arm stands, with a segmenter of the test's."""

    def __init__(self, env: Any, order: int = 1) -> None:
        self.env = env
        width, height = IMAGE_SIZE
        self.camera = SimulatedCamera(
            env.world.scene, picture=lambda k: np.zeros((height, width, 3), np.uint8)
        )
        self.perception = CameraPerception(1, FruitDetector(LabelSegmenter(env, order)))

    def look(self) -> float:
        T_w_links = link_transforms(self.env.agent.robot.get_qpos())
        T_w_camera = self.env.world.camera_poses(T_w_links)
        frames = self.camera.take(T_w_camera, self.env.plant_batch.T_world_plant, T_w_links)
        self.perception.look(frames)
        return float(self.perception.visible_fraction[0])


def test_of_several_fruits_found_the_one_near_the_known_place_is_the_target() -> None:
    env = make(perception="occlusion_model")
    env.reset(seed=2)
    place = env.target_position_w[0].numpy()
    seen = []
    for order in (1, -1):
        eye = Eye(env, order)
        eye.perception.begin(0, place)
        seen.append(eye.look())
        eye = Eye(env, order)
        eye.perception.begin(0, place + 1.0)
        assert eye.look() == 0.0, "a fruit a metre away is another one"
    assert seen[0] == seen[1] > 0.0
    env.close()


def test_what_the_first_view_of_a_hidden_target_shows_well_is_not_taken_for_it() -> None:
    env: Any = gym.make(
        "TomatoViewpoint-v1", obs_mode="state", render_backend="none", start_visibility=(0.7, 1.0)
    ).unwrapped
    env.reset(seed=0)
    seen = []
    for hidden_below in (None, 0.3):
        eye = Eye(env)
        eye.perception.begin(0, env.target_position_w[0].numpy(), hidden_below=hidden_below)
        seen += [eye.look(), eye.look()]
    assert min(seen[:2]) > 0.45
    assert seen[2:] == [0.0, 0.0]
    env.close()


def test_a_fruit_of_which_a_view_tells_no_more_than_the_direction_is_the_target_when_its_depth_is_measured() -> (
    None
):
    # A round tomato of 27 mm in (0, 0, 0.5) before cameras that look along the world's z.
    intrinsics = color_intrinsics(*IMAGE_SIZE)
    u, v = np.meshgrid(np.arange(IMAGE_SIZE[0]) + 0.5, np.arange(IMAGE_SIZE[1]) + 0.5)
    perception = CameraPerception(1, FruitDetector(None))
    perception.begin(0, np.array([0.01, 0.0, 0.5]), place_error=0.02)
    located = []
    for camera_x, has_depth in ((0.0, False), (0.02, True)):
        x = camera_x + 0.5 * (u - intrinsics.cx) / intrinsics.fx
        y = 0.5 * (v - intrinsics.cy) / intrinsics.fy
        away = np.hypot(x, y)
        mask = away < 0.027
        depth = np.where(mask, 0.5 - np.sqrt(np.maximum(0.027**2 - away**2, 0.0)), 0.8) * has_depth
        pose = np.eye(4)
        pose[0, 3] = camera_x
        frame = PosedFrame(
            depth_m=depth.astype(np.float32),
            intrinsics=intrinsics,
            T_world_camera=pose,
            told_fruits=Instances.from_masks(mask[None], categories=("tomato_ripe",)),
        )
        perception.look([frame])
        located.append(bool(perception.is_located[0]))
    assert located == [False, True]
    assert float(perception.visible_fraction[0]) > 0.8


class LabelSegmenter:
    """The target's mask and one of another fruit, in either order."""

    def __init__(self, env: Any, order: int) -> None:
        T_w_links = link_transforms(env.agent.robot.get_qpos())
        images = env.world.scene.image(
            color_intrinsics(*IMAGE_SIZE),
            env.world.camera_poses(T_w_links),
            env.target_fruit,
            env.plant_batch.T_world_plant,
            T_w_links,
        )
        target = (images.role[0] == int(Role.TARGET)).numpy()
        other = np.zeros_like(target)
        other[:30, :30] = True
        self._masks = np.stack([target, other][::order])

    def __call__(self, image: Any, depth_m: Any = None) -> Instances:
        return Instances(
            boxes=np.array([[0, 0, 5, 5], [0, 0, 5, 5]], np.float32),
            scores=np.array([0.9, 0.8], np.float32),
            categories=("tomato", "tomato"),
            masks=self._masks,
        )


def test_rendered_perception_without_a_renderer_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="render_backend"):
        make(perception="segmenter")
