"""The glasshouse of pictures: it looks like one and changes nothing that is measured."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import SemanticClass
from maniskill_tomato.plants.row import ROW_SPACING, generate_row
from maniskill_tomato.rendering.glasshouse import stem_feet

SEED = 3


def make(scenery: str) -> Any:
    return gym.make(
        "TomatoViewpoint-v1",
        obs_mode="rgb+segmentation",
        render_mode="rgb_array",
        episodes="held_out",
        scenery=scenery,
        sensor_configs={"width": 160, "height": 120},
        human_render_camera_configs={"width": 320, "height": 240},
    )


@pytest.fixture(scope="module")
def both() -> Iterator[dict[str, dict[str, Any]]]:
    """What one episode shows and gives in either scenery."""
    found: dict[str, dict[str, Any]] = {}
    for scenery in ("plain", "greenhouse"):
        env = make(scenery)
        obs, _ = env.reset(seed=SEED)
        fractions = []
        for action in ([0.5, 0.0, 0.0], [0.0, -0.6, 0.2]):
            obs, reward, _, _, info = env.step(torch.tensor([action]))
            fractions += [float(info["visible_fraction"]), float(reward)]
        sensor = obs["sensor_data"]["d435"]
        world = env.unwrapped
        found[scenery] = {
            "fractions": fractions,
            "state": obs["extra"],
            "rgb": sensor["rgb"][0].cpu().numpy(),
            "ids": sensor["segmentation"][0, ..., 0].cpu().numpy(),
            "classes": world.semantic_classes(),
            "outside": world.render_rgb_array()[0].cpu().numpy(),
            "camera": world.scene.human_render_cameras["render_camera"].camera,
            "links": [link.pose.p[0].cpu().numpy() for link in world.agent.robot.get_links()],
        }
    yield found


@pytest.mark.render
def test_it_changes_nothing_that_the_game_measures(both: dict[str, dict[str, Any]]) -> None:
    plain, house = both["plain"], both["greenhouse"]
    assert house["fractions"] == plain["fractions"]
    for name, value in plain["state"].items():
        torch.testing.assert_close(house["state"][name], value, rtol=0.0, atol=0.0)
    assert list(house["classes"].values()) == list(plain["classes"].values())


@pytest.mark.render
def test_it_hides_nothing_of_the_plants_from_the_wrist_camera(both: dict[str, dict[str, Any]]) -> None:
    kinds, organs = [], []
    for scenery in ("plain", "greenhouse"):
        classes, ids = both[scenery]["classes"], both[scenery]["ids"]
        first = min(number for number, kind in classes.items() if kind != SemanticClass.ROBOT)
        kinds.append(np.vectorize(lambda number, of=classes: int(of.get(number, -1)))(ids))
        organs.append(ids - first)
    fruits_and_leaves = [
        int(kind) for kind in SemanticClass if kind not in (SemanticClass.ROBOT, SemanticClass.STEM)
    ]
    seen = np.isin(kinds[0], fruits_and_leaves)
    assert seen.mean() > 0.1
    np.testing.assert_array_equal(np.where(seen, organs[1], -1), np.where(seen, organs[0], -1))


@pytest.mark.render
def test_pictures_have_rows_behind_and_are_well_exposed(both: dict[str, dict[str, Any]]) -> None:
    for name in ("rgb", "outside"):
        plain, house = (both[scenery][name].astype(int) for scenery in ("plain", "greenhouse"))
        green = [(p[..., 1] > 1.2 * np.maximum(p[..., 0], p[..., 2])).mean() for p in (plain, house)]
        assert green[1] > green[0] + 0.02, "no rows behind"
        assert (house.min(-1) > 252).mean() < 0.02, "overexposed"
        assert 90 < house.mean() < 225


@pytest.mark.render
def test_the_whole_robot_is_in_the_picture(both: dict[str, dict[str, Any]]) -> None:
    house = both["greenhouse"]
    camera = house["camera"]
    extrinsic, intrinsic = (
        m[0].cpu().numpy() for m in (camera.get_extrinsic_matrix(), camera.get_intrinsic_matrix())
    )
    points = np.concatenate([house["links"], [[0.0, 0.0, -0.3]]])
    local = points @ extrinsic[:, :3].T + extrinsic[:, 3]
    places = local @ intrinsic.T
    places = places[:, :2] / places[:, 2:]
    height, width = house["outside"].shape[:2]
    assert (places > 0).all() and (places < [width, height]).all()


def test_each_plant_of_a_row_has_a_foot() -> None:
    row = generate_row("full", 12)
    feet = stem_feet(row)
    np.testing.assert_allclose(feet[:, 1], [-ROW_SPACING, 0.0, ROW_SPACING], atol=0.06)
    np.testing.assert_allclose(feet[:, [0, 2]], 0.0, atol=0.06)
    np.testing.assert_allclose(stem_feet(generate_plant("one_tomato", 0)), np.zeros((1, 3)), atol=0.03)


def test_another_scenery_or_more_environments_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="'plain', 'greenhouse'"):
        make("jungle")
    with pytest.raises(InvalidInputError, match="num_envs"):
        gym.make("TomatoViewpoint-v1", num_envs=2, scenery="greenhouse", sim_backend="cpu")
