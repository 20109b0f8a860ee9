"""Compares the ray-cast visible fraction with rendered segmentation images; draws a plot and prints JSON.

Example:
    python tools/compare_visibility.py --plot docs/images/visibility_comparison.png
"""

import json
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from maniskill_tomato.rendering.rendered_visibility import ComparedView, compare


def draw(views: list[ComparedView], path: Path) -> None:
    """Saves both fractions of every view, and their differences, as a picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.2), layout="constrained")
    left.plot([0, 1], [0, 1], color="0.7", linewidth=1, zorder=0)
    for preset, colour in zip(
        sorted({v.preset for v in views}), ("#4c9a2a", "#d1495b", "#2e6f95"), strict=False
    ):
        chosen = [v for v in views if v.preset == preset]
        left.scatter([v.rendered for v in chosen], [v.cast for v in chosen], s=10, color=colour, label=preset)
    left.set(xlabel="V_f from segmentation images", ylabel="V_f by ray casting", aspect="equal")
    left.legend(frameon=False)
    differences = np.array([v.difference for v in views])
    right.hist(differences, bins=40, color="#4c9a2a")
    right.set(
        xlabel="ray casting minus images",
        ylabel="views",
        title=f"mean |difference| {np.abs(differences).mean():.4f}, maximum {np.abs(differences).max():.4f}",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(
    plants: int = 30,
    views_per_plant: int = 10,
    rays_per_side: int = 16,
    seed: int = 0,
    plot: Path | None = None,
) -> None:
    """Compares random views of random plants.

    Args:
        plants: Number of plants; the presets take turns.
        views_per_plant: Random viewpoints of each.
        rays_per_side: The square of this number of rays per view.
        seed: Which plants and viewpoints.
        plot: Where to save a picture of the comparison.
    """
    with tqdm(total=plants, unit="plant") as bar:
        views = compare(plants, views_per_plant, rays_per_side, seed, on_plant=lambda _: bar.update())
    if plot is not None:
        draw(views, plot)
    differences = np.abs([v.difference for v in views])
    worst = sorted(views, key=lambda v: -abs(v.difference))[:5]
    report = {
        "views": len(views),
        "plants": plants,
        "rays": rays_per_side**2,
        "mean_absolute_difference": float(differences.mean()),
        "max_absolute_difference": float(differences.max()),
        "bias": float(np.mean([v.difference for v in views])),
        "views_by_rendered_fraction": np.histogram([v.rendered for v in views], 10, (0, 1))[0].tolist(),
        "worst": [
            {
                "preset": v.preset,
                "seed": v.seed,
                "target_fruit": v.target_fruit,
                "rendered": v.rendered,
                "cast": v.cast,
                "T_plant_camera": v.T_plant_camera.tolist(),
            }
            for v in worst
        ],
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    tyro.cli(main)
