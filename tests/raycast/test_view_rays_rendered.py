"""View rays cast at meshes against those sampled from rendered depth and segmentation images."""

import math

import numpy as np
import pytest
import torch

from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import RANGE, RayLabel
from maniskill_tomato.robot.look_at import camera_to_viewpoint, look_at_pose
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.view_pattern import sample_view

pytestmark = [pytest.mark.render, pytest.mark.usefixtures("backend")]

PLANTS = 8
VIEWS = 3


def test_a_rendered_image_tells_what_the_rays_tell_and_gives_the_same_observation(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from maniskill_tomato.rendering.rendered_visibility import COMPARISON_INTRINSICS, SegmentedPlant

    rng = np.random.default_rng(0)
    equal, errors, seen, observation_errors = [], [], [], []
    for seed in range(PLANTS):
        plant = generate_plant("full" if seed % 2 else "three_tomatoes", seed, "training")
        segmented = SegmentedPlant(plant, COMPARISON_INTRINSICS)
        scene = RayScene([plant], COMPARISON_INTRINSICS)
        fruit = int(rng.integers(len(plant.fruits)))
        centre = torch.from_numpy(plant.fruits[fruit].centre.astype(np.float64))
        observers = [ViewpointObserver(), ViewpointObserver()]
        for observer in observers:
            observer.begin(torch.tensor([0]), centre[None].float())
        for view in range(VIEWS):
            azimuth, elevation = rng.uniform(-math.pi / 2, math.pi / 2), rng.uniform(-0.8, 0.8)
            direction = [-math.cos(azimuth), -math.sin(azimuth), math.tan(elevation)]
            away = torch.tensor(direction, dtype=torch.float64)
            position = centre + rng.uniform(0.25, 0.8) * away / away.norm()
            pose = look_at_pose(position, centre, rng.uniform(-math.pi, math.pi))
            organs, depth = segmented.picture_with_depth(pose.numpy())
            # A greenhouse has a wall somewhere; a picture of a plant alone has nothing.
            depth = np.where(np.isinf(depth), 2 * RANGE, depth)
            is_target = organs == plant.fruits[fruit].organ_index
            sampled = sample_view(depth, is_target, COMPARISON_INTRINSICS, pose, centre)
            cast = scene.view_rays(
                pose.float()[None], torch.tensor([fruit]), centre.float()[None], torch.eye(4)[None]
            )
            torch.testing.assert_close(sampled.direction_c, cast.direction_c, atol=1e-5, rtol=0)
            same = sampled.label == cast.label
            equal.append(float(same.float().mean()))
            hit = same & (cast.label >= RayLabel.TARGET)
            errors.append((sampled.distance - cast.distance)[hit].abs())
            seen.append(float((cast.label == RayLabel.TARGET).float().sum()))
            viewpoint = camera_to_viewpoint(pose[None], torch.zeros(1, 3, dtype=torch.float64))
            vectors = [
                observer.observe(viewpoint, pose[None], rays, torch.tensor([0.5]), torch.tensor([20 - view]))
                for observer, rays in zip(observers, (sampled, cast), strict=True)
            ]
            observation_errors.append((vectors[0] - vectors[1]).abs())
    error, difference = torch.cat(errors), torch.cat(observation_errors)
    with capsys.disabled():
        print(
            f"\n{len(equal)} views: {np.mean(equal):.4f} of the labels equal (worst view {np.min(equal):.4f}), "
            f"distance error median {error.median() * 1e3:.2f} mm, 95 % {error.quantile(0.95) * 1e3:.2f} mm; "
            f"observation mean {difference.mean():.4f}, 99 % {difference.flatten().quantile(0.99):.3f}"
        )
    assert np.mean(equal) > 0.98 and np.min(equal) > 0.93
    # Depth comes in whole millimetres, and a pixel may show what is beside the ray.
    assert float(error.median()) < 1.5e-3
    assert float(error.quantile(0.95)) < 5e-3
    assert float(difference.mean()) < 0.02
    # The views must ask something: the target is hidden in some and well seen in others.
    assert np.min(seen) == 0 and np.max(seen) >= 6
