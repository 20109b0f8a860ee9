"""Holds what the occlusion memory predicts against the truth on many plants, and measures what an observation costs.

Every episode is a full plant with a ripe target, a start from where less than 0.3 of it is seen and five more
reachable views chosen at random. After one, three and six views the prediction for each reachable candidate of the
view lattice is compared with its visible fraction. Prints JSON; `--plot` draws an episode (needs a Vulkan device).

Example:
    python tools/measure_memory.py --plants 80 --plot docs/images/observation.png
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Plant, SemanticClass
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import camera_to_viewpoint, look_at_pose
from maniskill_tomato.sensing.observation import PART_SHAPES, ViewpointObserver
from maniskill_tomato.sensing.view_lattice import ViewLattice

AFTER_VIEWS = (1, 3, 6)
PLANT_X = 0.85


@dataclass(frozen=True)
class Episode:
    """A plant, its target, the truth about every candidate, and the candidates looked from."""

    plant: Plant
    fruit: int
    target: Tensor
    poses: Tensor
    truth: Tensor
    reachable: Tensor
    order: list[int]
    scene: RayScene


def make_episode(seed: int, lattice: ViewLattice) -> Episode | None:
    """None for a plant without a ripe fruit, a hard start or a good view."""
    rng = np.random.default_rng(seed)
    plant = generate_plant("full", seed, "training")
    ripe = [i for i, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe"]
    if not ripe:
        return None
    fruit = int(rng.choice(ripe))
    target = torch.from_numpy(plant.fruits[fruit].centre)[None] + torch.tensor([[PLANT_X, 0.0, 0.0]])
    scene = RayScene([plant], color_intrinsics())
    positions = lattice.positions(target)[0]
    poses = look_at_pose(positions, target.expand_as(positions))
    truth = scene.visible_fraction_from(poses, fruit, plant_pose())
    reachable = lattice.reachable(target)[0]
    hard = torch.nonzero(reachable & (truth < 0.3))[:, 0].tolist()
    if not hard or not bool((reachable & (truth > 0.8)).any()):
        return None
    others = rng.choice(torch.nonzero(reachable)[:, 0].numpy(), max(AFTER_VIEWS) - 1, replace=False)
    order = [int(rng.choice(hard)), *map(int, others)]
    return Episode(plant, fruit, target, poses, truth, reachable, order, scene)


def plant_pose() -> Tensor:
    """Where the plants stand. Shape (4, 4)."""
    pose = torch.eye(4)
    pose[0, 3] = PLANT_X
    return pose


def look(episode: Episode, observer: ViewpointObserver, k: int) -> Tensor:
    """The observation after the k-th view."""
    index = episode.order[k]
    pose = episode.poses[index : index + 1]
    view = episode.scene.view_rays(pose, torch.tensor([episode.fruit]), episode.target, plant_pose()[None])
    viewpoint = camera_to_viewpoint(pose, torch.zeros(1, 3))
    return observer.observe(viewpoint, pose, view, episode.truth[index : index + 1], torch.tensor([20 - k]))


def judge(episodes: list[Episode]) -> dict[str, dict[str, float]]:
    """Prediction against truth, by the number of views."""
    rows: dict[int, list[list[float]]] = {views: [] for views in AFTER_VIEWS}
    observer = ViewpointObserver()
    for episode in tqdm(episodes, unit="episode"):
        observer.begin(torch.tensor([0]), episode.target)
        truth = episode.truth[episode.reachable].numpy()
        for k in range(max(AFTER_VIEWS)):
            look(episode, observer, k)
            if k + 1 in rows:
                predicted = observer.memory.predict(episode.poses[None, :, :3, 3])[0, :, 0]
                chosen = predicted[episode.reachable].numpy()
                correlation = float(np.corrcoef(chosen, truth)[0, 1])
                best = float(truth[chosen.argmax()])
                rows[k + 1].append([correlation, best, best > 0.8, float(np.abs(chosen - truth).mean())])
    names = ("correlation", "visible_fraction_at_best", "best_is_above_0.8", "mean_absolute_error")
    return {
        f"after_{views}_views": dict(zip(names, np.nanmean(table, axis=0).tolist(), strict=True))
        for views, table in rows.items()
    }


def processor_ms(work: Callable[[], object], repeats: int) -> float:
    """Processor time of one call, in [ms]."""
    work()
    begin = time.process_time()
    for _ in range(repeats):
        work()
    return (time.process_time() - begin) / repeats * 1e3


def measure(episode: Episode) -> dict[str, float]:
    """Processor time of each piece for one environment."""
    observer = ViewpointObserver()
    observer.begin(torch.tensor([0]), episode.target)
    look(episode, observer, 0)
    pose = episode.poses[episode.order[0]][None]
    fruit, plant = torch.tensor([episode.fruit]), plant_pose()
    view = observer.belief.rays
    viewpoint, fraction, left = observer.belief.viewpoint, torch.tensor([0.5]), torch.tensor([19])
    generator = torch.Generator().manual_seed(0)
    positions = episode.target[:, None] + 0.3 * torch.randn(1, 2000, 3, generator=generator)
    scene = episode.scene
    return {
        "cast_256_rays_ms": processor_ms(
            lambda: scene.view_rays(pose, fruit, episode.target, plant[None]), 200
        ),
        "observe_ms": processor_ms(lambda: observer.observe(viewpoint, pose, view, fraction, left), 200),
        "predict_500_ms": processor_ms(lambda: observer.memory.predict(positions[:, :500]), 100),
        "predict_2000_ms": processor_ms(lambda: observer.memory.predict(positions), 50),
        "begin_ms": processor_ms(lambda: observer.begin(torch.tensor([0]), episode.target), 20),
        "cast_views_per_second": 1e3
        * len(episode.poses)
        / processor_ms(lambda: scene.visible_fraction_from(episode.poses, episode.fruit, plant), 5),
    }


def draw(episode: Episode, path: Path) -> None:
    """Saves three views of an episode: the image with its rays, patch, map, truth and the lattice's prediction."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    from maniskill_tomato.rendering.rendered_visibility import COMPARISON_INTRINSICS, SegmentedPlant

    colours = {SemanticClass.LEAF: (0.45, 0.65, 0.4), SemanticClass.STEM: (0.55, 0.45, 0.3)}
    segmented = SegmentedPlant(episode.plant, COMPARISON_INTRINSICS)
    observer = ViewpointObserver()
    observer.begin(torch.tensor([0]), episode.target)
    figure, axes = plt.subplots(3, 6, figsize=(14.0, 7.0), layout="constrained")
    for k, row in enumerate(axes):
        observation = look(episode, observer, k)[0]
        pose = episode.poses[episode.order[k]]
        organs = segmented.picture((torch.linalg.inv(plant_pose()) @ pose).double().numpy())
        picture = np.ones((*organs.shape, 3))
        for index, organ in enumerate(episode.plant.organs):
            picture[organs == index] = colours.get(organ.semantic_class, (0.95, 0.65, 0.3))
        picture[organs == episode.plant.fruits[episode.fruit].organ_index] = (0.85, 0.1, 0.1)
        row[0].imshow(picture)
        pixels = COMPARISON_INTRINSICS.project(observer.belief.rays.direction_c[0].numpy())
        row[0].scatter(*pixels.T, c=observer.belief.rays.label[0].numpy(), s=3, cmap="cool")
        row[0].set(
            title=f"view {k + 1}: $V_f$ = {float(episode.truth[episode.order[k]]):.2f}",
            xlim=(0, 640),
            ylim=(480, 0),
        )
        parts = observer.layout.slices
        patch = observation[parts["patch"]].view(PART_SHAPES["patch"])
        maps = observation[parts["map"]].view(PART_SHAPES["map"])
        for axis, image, title in (
            (row[1], patch[0], "patch: target"),
            (row[2], patch[2], "patch: gap"),
            (row[3], maps[0], "map: predicted"),
            (row[4], 2 * maps[1] - 1, "map: unknown"),
        ):
            axis.imshow(image, vmin=-1, vmax=1, cmap="RdYlGn" if axis is not row[2] else "coolwarm")
            axis.set(title=title)
        predicted = observer.memory.predict(episode.poses[None, :, :3, 3])[0, episode.reachable, 0]
        truth = episode.truth[episode.reachable]
        row[5].scatter(predicted, truth, s=5, color="#2e6f95")
        correlation = float(torch.corrcoef(torch.stack([predicted, truth]))[0, 1])
        row[5].set(title=f"truth, prediction: r = {correlation:.2f}", xlim=(0, 1), ylim=(-0.02, 1.02))
        for axis in row[:5]:
            axis.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main(plants: int = 80, first_seed: int = 0, plot: Path | None = None, drawn: int = 0) -> None:
    """Judges the memory on full plants.

    Args:
        plants: Number of plants; those without a ripe fruit, a hard start and a good view are left out.
        first_seed: Seed of the first one.
        plot: Where to save a picture of an episode.
        drawn: Which of the episodes that is.
    """
    torch.set_num_threads(1)
    lattice = ViewLattice()
    made = [make_episode(seed, lattice) for seed in range(first_seed, first_seed + plants)]
    episodes = [episode for episode in made if episode is not None]
    report: dict[str, object] = {"episodes": len(episodes), **judge(episodes), **measure(episodes[0])}
    if plot is not None:
        draw(episodes[drawn], plot)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    tyro.cli(main)
