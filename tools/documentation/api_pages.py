"""Pages of the API reference: one for each room of the package, written from the docstrings of its modules."""

from pathlib import Path
from typing import Final

PUBLIC: Final[dict[str, tuple[str, ...]]] = {
    "robot": (
        "arm_model",
        "arm_urdf",
        "iiwa14",
        "d435",
        "kinematics",
        "inverse_kinematics",
        "look_at",
        "look_at_move",
        "viewpoint_move",
        "transit",
        "out_of_reach",
        "depth_noise",
        "rotations",
        "spheres",
    ),
    "plants": (
        "generator",
        "plant_config",
        "kinds",
        "organs",
        "row",
        "spec",
        "seed_splits",
        "episode_list",
        "mesh_plant",
        "mesh_rules",
        "mesh_set",
        "decimation",
    ),
    "raycast": ("scene", "visibility", "view_rays", "images"),
    "rendering": ("rendered_visibility", "vulkan_probe"),
    "segmentation": (
        "segmenter",
        "instances",
        "detector_configs",
        "light_segmenter",
        "colour_segmenter",
        "mask_rcnn",
        "yolo",
        "masks",
        "drawing",
        "detection_list",
        "datasets.annotations",
        "datasets.reading",
        "datasets.coco",
        "datasets.voc",
        "metrics.detection_metrics",
        "metrics.detector_evaluation",
        "synthesis.dataset_rendering",
    ),
    "sensing": (
        "posed_frame",
        "belief",
        "observation",
        "occlusion_memory",
        "view_lattice",
        "view_pattern",
        "fruit_detector",
        "fruit_map",
        "camera_perception",
        "inspection",
        "measurement",
        "sensor_noise",
        "perception_kinds",
        "visible_fraction.estimate",
        "visible_fraction.occlusion_models",
    ),
    "policies": (
        "protocol",
        "opening",
        "registry",
        "layout",
        "description",
        "onnx_policy",
        "trained_actor",
        "baselines",
        "next_best_view",
        "move_to_see",
        "gradient_view",
        "view_quality",
        "oracle",
        "adapters",
    ),
    "tasks": (
        "making",
        "world",
        "world_state",
        "vector_env",
        "registration",
        "own_rules",
        "thesis.thesis_config",
        "thesis.thesis_rewards",
        "row.row_config",
        "row.episode_sampling",
        "lerobot_env",
        "maniskill.registered_envs",
        "maniskill.shell_options",
        "maniskill.iiwa14_agent",
        "maniskill.controllers",
    ),
    "learning": (
        "rl.gymnasium_env",
        "rl.gymnasium_vec",
        "rl.sb3_vec",
        "rl.train_config",
        "rl.presets",
        "rl.trainer",
        "rl.checkpoint",
        "rl.export",
        "imitation.imitation_config",
        "imitation.imitation_training",
        "view_quality.quality_config",
        "view_quality.quality_training",
    ),
    "experiments": (
        "configs",
        "rollout",
        "episode_record",
        "metrics",
        "statistics",
        "evaluation",
        "viewpoint_benchmark",
        "row_benchmark",
        "run_comparison",
    ),
    "deploy": (
        "interface",
        "drivers",
        "profile",
        "profile_bounds",
        "safety_config",
        "safety",
        "guarded_arm",
        "loop",
        "policy_run",
        "inspection_run",
        "recording_reader",
        "calibration.calibration_file",
        "calibration.hand_eye",
        "arm_session",
        "real_agent",
        "sim2real",
        "deploy_errors",
    ),
    "conversion": (
        "lerobot_conversion",
        "lerobot_dataset",
        "episodes",
        "demonstration_episodes",
        "recorded_runs",
    ),
}
"""The public modules of each room, the most useful first; rooms in the order of the map in CONTRIBUTING.md."""


def write_api_pages(folder: Path) -> None:
    """Writes the pages into the folder `api` of the staged site.

    Args:
        folder: Where Sphinx reads the site.
    """
    place = folder / "api"
    place.mkdir()
    lines = [
        "# API reference",
        "",
        "What the docstrings of the public modules say. One page is one room of the package; the",
        "[map of the house](../contributing.md#the-map-of-the-house) says what each is for. Everything is imported",
        "from its module: `from maniskill_tomato.robot.kinematics import ...`. Modules that are not listed are",
        "internal ([compatibility](../compatibility.md#what-stays)).",
        "",
        "| room | modules |",
        "|---|---|",
    ]
    for room, modules in PUBLIC.items():
        lines.append(f"| [{room}]({room}.rst) | {', '.join(f'`{module}`' for module in modules)} |")
        (place / f"{room}.rst").write_text(_page(room, modules), encoding="utf-8")
    lines += ["", "```{toctree}", ":hidden:", "", *PUBLIC, "```", ""]
    (place / "index.md").write_text("\n".join(lines), encoding="utf-8")


def _page(room: str, modules: tuple[str, ...]) -> str:
    lines = [room, "=" * len(room), ""]
    for module in modules:
        lines += [module, "-" * len(module), "", f".. automodule:: maniskill_tomato.{room}.{module}", ""]
    return "\n".join(lines)
