"""What the real LeRobot makes of a converted data set and of the plug-ins, as JSON on the last line of the output.

    PYTHON_OF_LEROBOT integrations/lerobot/check_with_lerobot.py dataset FOLDER WORK
    PYTHON_OF_LEROBOT integrations/lerobot/check_with_lerobot.py robot WORK
    PYTHON_OF_LEROBOT integrations/lerobot/check_with_lerobot.py env WORK

`tests/integrations/test_lerobot.py` runs it, and compares what it prints with values of its own.
"""

import hashlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import _call_make_env, _load_module_from_path, _normalize_hub_result
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import (
    build_dataset_frame,
    dataset_to_policy_features,
    hw_to_dataset_features,
)
from lerobot.utils.import_utils import register_third_party_plugins

COUNTED = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def digest(image: torch.Tensor, is_depth: bool) -> str:
    """Of an image of a frame, as the array that was written: rows, columns, channels."""
    scaled = image if is_depth else image * 255.0
    array = scaled.permute(1, 2, 0).round().numpy().astype(np.uint16 if is_depth else np.uint8)
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def check_dataset(folder: Path, work: Path) -> dict[str, Any]:
    """Loads, looks back in time, batches, writes the same anew, edits, and computes a loss."""
    dataset = LeRobotDataset("local/converted", root=folder)
    depth = set(dataset.meta.depth_keys)
    images = set(dataset.meta.image_keys)
    frames = []
    for index in range(len(dataset)):
        item = dataset[index]
        frames.append(
            {
                key: digest(value, key in depth) if key in images else np.asarray(value).tolist()
                for key, value in item.items()
                if key != "task"
            }
            | {"task": item["task"]}
        )
    step = 1.0 / dataset.fps
    looking_back = LeRobotDataset(
        "local/converted",
        root=folder,
        delta_timestamps={"observation.state": [-step, 0.0], "action": [0.0, step]},
    )
    back = [
        {"state": item["observation.state"].tolist(), "action_is_pad": item["action_is_pad"].tolist()}
        for item in (looking_back[index] for index in range(len(looking_back)))
    ]
    loader = torch.utils.data.DataLoader(dataset, batch_size=3, shuffle=False, num_workers=0)
    batches = [{key: list(v.shape) for key, v in batch.items() if torch.is_tensor(v)} for batch in loader]
    return {
        "frames": frames,
        "back": back,
        "batches": batches,
        "depth_keys": sorted(depth),
        "rewritten": compare_with_rewritten(dataset, work / "rewritten"),
        "edited": check_editing(dataset, work),
        "loss": loss_of_act(folder) if images else None,
    }


def compare_with_rewritten(dataset: LeRobotDataset, root: Path) -> dict[str, Any]:
    """The same frames by LeRobot's own writer: how far its statistics are from ours, as shares of the range or size."""
    features = {key: one for key, one in dataset.meta.features.items() if key not in COUNTED}
    written = LeRobotDataset.create(
        "local/rewritten",
        fps=dataset.fps,
        features=json.loads(json.dumps(features), object_hook=_with_tuples),
        root=root,
        use_videos=False,
        robot_type=dataset.meta.robot_type,
    )
    lengths = list(dataset.meta.episodes["length"])
    index = 0
    for length in lengths:
        for _ in range(length):
            item = dataset[index]
            frame: dict[str, Any] = {"task": item["task"]}
            for key, one in features.items():
                value = item[key]
                if one["dtype"] == "image":
                    is_depth = key in dataset.meta.depth_keys
                    array = (value if is_depth else value * 255.0).permute(1, 2, 0).round().numpy()
                    frame[key] = array.astype(np.uint16 if is_depth else np.uint8)
                else:
                    frame[key] = np.atleast_1d(value.numpy())
            written.add_frame(frame)
            index += 1
        written.save_episode()
    written.finalize()
    ours, theirs = dataset.meta.stats, LeRobotDataset("local/rewritten", root=root).meta.stats
    off: dict[str, dict[str, float]] = {}
    for key, their in theirs.items():
        # What never changes is compared with its size: single precision is relative.
        span = np.maximum(their["max"] - their["min"], np.maximum(np.abs(their["max"]), 1e-6))
        off[key] = {}
        for name, values in their.items():
            assert ours[key][name].shape == values.shape, (key, name)
            off[key][name] = float(
                np.max(np.abs(ours[key][name] - values) / (1.0 if name == "count" else span))
            )
    info = json.loads((root / "meta" / "info.json").read_text())
    return {"off": off, "info": info}


def _with_tuples(found: dict[str, Any]) -> dict[str, Any]:
    if "shape" in found:
        found["shape"] = tuple(found["shape"])
    return found


def check_editing(dataset: LeRobotDataset, work: Path) -> dict[str, Any]:
    """LeRobot's tools take an episode away, and put two data sets together."""
    if dataset.num_episodes < 2:
        return {}
    kept = delete_episodes(dataset, [0], output_dir=work / "kept", repo_id="local/kept")
    merged = merge_datasets([dataset, kept], output_dir=work / "merged", output_repo_id="local/merged")
    return {
        "kept": [len(kept), kept.num_episodes],
        "merged": [len(merged), merged.num_episodes],
        "first_kept": np.asarray(kept[0]["observation.state"]).tolist(),
    }


def loss_of_act(folder: Path) -> float:
    """A small ACT reads features and statistics, and finds a loss."""
    config = ACTConfig(
        device="cpu",
        push_to_hub=False,
        pretrained_backbone_weights=None,
        chunk_size=2,
        n_action_steps=2,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
    )
    metadata = LeRobotDataset("local/converted", root=folder).meta
    # Its network takes images of three channels.
    named = dataset_to_policy_features(metadata.features)
    config.input_features = {
        key: one
        for key, one in named.items()
        if one.type is not FeatureType.ACTION and key not in metadata.depth_keys
    }
    policy = make_policy(config, ds_meta=metadata)
    before, _ = make_pre_post_processors(config, dataset_stats=metadata.stats)
    times = {ACTION: [k / metadata.fps for k in range(2)]}
    dataset = LeRobotDataset("local/converted", root=folder, delta_timestamps=times)
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=2)))
    loss, _ = policy.forward(before(batch))
    return float(loss)


def check_robot(work: Path) -> dict[str, Any]:
    """Finds the plug-ins, drives the twin, records it, and asks for what must be refused."""
    register_third_party_plugins()
    kind = RobotConfig.get_choice_class("kuka_iiwa")
    robot = make_robot_from_config(kind(id="twin", calibration_dir=work / "calibration"))
    found: dict[str, Any] = {"unconnected": outcome(robot.get_observation)}
    features = {
        **hw_to_dataset_features(robot.observation_features, OBS_STR, use_video=False),
        **hw_to_dataset_features(robot.action_features, ACTION, use_video=False),
    }
    found["features"] = json.loads(json.dumps(features))
    robot.connect()
    found["connected_twice"] = outcome(robot.connect)
    recorded = LeRobotDataset.create(
        "local/recorded", fps=1, features=features, root=work / "recorded", use_videos=False
    )
    observations, sent = [], []
    for turn in (0.04, -0.03, 0.02):
        observation = robot.get_observation()
        joints = {key: observation[key] for key in robot.action_features}
        wanted = {**joints, "joint_7.pos": joints["joint_7.pos"] + turn}
        sent.append(robot.send_action(wanted))
        frame = build_dataset_frame(features, observation, OBS_STR) | build_dataset_frame(
            features, wanted, ACTION
        )
        recorded.add_frame({**frame, "task": "turn"})
        observations.append(
            {"joints": joints, "wanted": wanted, "depth": str(observation["wrist_depth"].dtype)}
        )
    recorded.save_episode()
    recorded.finalize()
    again = LeRobotDataset("local/recorded", root=work / "recorded")
    last = robot.get_observation()
    stands = {key: last[key] for key in robot.action_features}
    found |= {
        "moves": observations,
        "sent": sent,
        "stands": stands,
        "recorded": len(again),
        "refused": {
            "far": outcome(lambda: robot.send_action({**stands, "joint_2.pos": stands["joint_2.pos"] + 2.0})),
            "nan": outcome(lambda: robot.send_action({**stands, "joint_2.pos": float("nan")})),
            "missing": outcome(lambda: robot.send_action({"joint_1.pos": 0.0})),
            "unknown": outcome(lambda: robot.send_action({**stands, "gripper.pos": 0.0})),
            "text": outcome(lambda: robot.send_action({**stands, "joint_2.pos": "far"})),
        },
        "after": {key: robot.get_observation()[key] for key in stands},
    }
    robot.disconnect()
    found["disconnected"] = not robot.is_connected
    holding = make_robot_from_config(
        kind(
            id="twin",
            calibration_dir=work / "calibration",
            on_refusal="hold",
            cameras={
                "side": CameraConfig.get_choice_class("maniskill_tomato")(width=424, height=240, fps=30)
            },
        )
    )
    with holding:
        first = holding.get_observation()
        start = {key: first[key] for key in holding.action_features}
        held = holding.send_action({**start, "joint_2.pos": start["joint_2.pos"] + 2.0})
        found |= {"held": [start, held], "side": list(first["side"].shape)}
        found["side_feature"] = list(holding.observation_features["side"])
    return found | {"camera": check_camera()}


def check_camera() -> dict[str, Any]:
    """Opens the camera of a profile alone."""
    kind = CameraConfig.get_choice_class("maniskill_tomato")
    camera = make_cameras_from_configs({"a": kind(use_depth=True)})["a"]
    found: dict[str, Any] = {"unconnected": outcome(camera.read), "known": camera.find_cameras()}
    camera.connect()
    color, depth = camera.read(), camera.read_latest_depth()
    found |= {
        "color": [str(color.dtype), list(color.shape)],
        "depth": [str(depth.dtype), list(depth.shape), int(depth.max())],
        "size": [camera.width, camera.height],
        "again": bool(np.array_equal(camera.read_latest(), color)),
        "unread": list(camera.async_read(60_000).shape),
        "late": outcome(lambda: camera.async_read(0.0)),
        "kept": list(camera.async_read(60_000).shape),
    }
    camera.disconnect()
    wrong = make_cameras_from_configs({"a": kind(width=640, height=480)})["a"]
    return found | {"wrong_size": outcome(wrong.connect), "stays_closed": not wrong.is_connected}


def outcome(call: Any) -> str:
    """The kind of error that a call raises, and its words."""
    try:
        call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "nothing"


@PreTrainedConfig.register_subclass("scripted")
@dataclass
class ScriptedConfig(PreTrainedConfig):
    """Of a policy that sees nothing."""

    observation_delta_indices = None
    action_delta_indices = None
    reward_delta_indices = None

    def get_optimizer_preset(self) -> None: ...
    def get_scheduler_preset(self) -> None: ...
    def validate_features(self) -> None: ...


class Scripted(PreTrainedPolicy):
    """The same moves in every episode: of step t, 0.1 cos(t + k) of the k-th number."""

    config_class = ScriptedConfig
    name = "scripted"

    def __init__(self, size: int) -> None:
        super().__init__(ScriptedConfig(device="cpu", push_to_hub=False))
        self.size, self.step, self.seen = size, 0, []

    def reset(self) -> None:
        self.step = 0

    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> torch.Tensor:
        self.seen.append({key: list(v.shape) for key, v in batch.items() if torch.is_tensor(v)})
        action = 0.1 * torch.cos(self.step + torch.arange(self.size, dtype=torch.float32))
        self.step += 1
        return action.expand(len(batch["task"]), -1).clone()

    def get_optim_params(self) -> dict[str, Any]:
        return {}

    def forward(self, batch: dict[str, Any]) -> tuple[torch.Tensor, None]:
        raise NotImplementedError  # Of training, which LeRobot's evaluation does not ask for.

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> torch.Tensor:
        raise NotImplementedError  # Of policies that plan several moves; this one has `select_action` alone.


def check_env(work: Path) -> dict[str, Any]:
    """Evaluates a policy on environments that come by EnvHub's file and by the plug-in."""
    register_third_party_plugins()
    module = _load_module_from_path(str(Path(__file__).parent / "envhub" / "env.py"))
    by_hub = _normalize_hub_result(_call_make_env(module, n_envs=2, use_async_envs=True, cfg=None))
    ((suite, tasks),) = by_hub.items()
    tasks[0].close()
    found: dict[str, Any] = {"suite": suite}
    identity = PolicyProcessorPipeline(steps=[])
    of_actions = PolicyProcessorPipeline(
        steps=[], to_transition=policy_action_to_transition, to_output=transition_to_policy_action
    )
    for name, options in (
        ("next_step", {"autoreset_mode": "NextStep"}),
        ("same_step", {"autoreset_mode": "SameStep"}),
    ):
        env = module.make_env(
            3,
            task="TomatoViewpointSparse-v1",
            obs_type="state",
            scene="thesis",
            max_episode_steps=6,
            **options,
        )
        policy = Scripted(6)
        info = eval_policy(
            env, policy, identity, identity, identity, of_actions, n_episodes=9, start_seed=100
        )
        found[name] = {"episodes": info["per_episode"], "percent": info["aggregated"]["pc_success"]}
        env.close()
    config = EnvConfig.get_choice_class("maniskill_tomato")(episodes="held_out")
    found["features"] = {
        config.features_map[key]: [list(one.shape), one.type is FeatureType.VISUAL]
        for key, one in config.features.items()
    }
    ((suite, tasks),) = make_env(config, n_envs=2, use_async_envs=True).items()
    policy = Scripted(3)
    info = eval_policy(
        tasks[0],
        policy,
        *config.get_env_processors(),
        identity,
        of_actions,
        n_episodes=2,
        start_seed=0,
        max_episodes_rendered=2,
        videos_dir=work / "videos",
    )
    tasks[0].close()
    found |= {
        "plugin_suite": suite,
        "seen": policy.seen[0],
        "films": [Path(p).stat().st_size for p in info["video_paths"]],
    }
    return found


def main() -> None:
    """Runs the check that is asked for."""
    what, *paths = sys.argv[1:]
    places = [Path(path) for path in paths]
    check = {"dataset": check_dataset, "robot": check_robot, "env": check_env}[what]
    torch.manual_seed(0)
    print(json.dumps(check(*places)))


if __name__ == "__main__":
    main()
