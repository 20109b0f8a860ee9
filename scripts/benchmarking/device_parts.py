"""What one command tells of a GPU: every part that can behave or perform otherwise there than on a CPU.

A part yields its findings one after the other, so that what was found before it fails is kept. What must hold and does
not raises `PartFailure` after the finding that shows it.
"""

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import torch
from torch import Tensor

import maniskill_tomato.tasks  # noqa: F401  Registers the environments.
from benchmarking.shells import Shells
from benchmarking.simulator import GENERAL, GUIDED, POOL, make_vector, resident_mib
from benchmarking.synchronisations import synchronisations
from benchmarking.turns import four_digits
from maniskill_tomato.experiments.rollout import run_episodes
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.presets import PresetName, get_preset
from maniskill_tomato.learning.rl.trainer import train
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.rendering.vulkan_probe import rendering_available
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.robot_description import link_meshes
from maniskill_tomato.segmentation.light_segmenter import FruitSession, open_light
from maniskill_tomato.tasks.making import make_world

Findings = Iterator[tuple[str, Any]]
"""Names and values that JSON can hold."""

ROOT: Final = Path(__file__).resolve().parents[2]
MIB: Final = 2**20
POSE_TOLERANCE: Final = 1e-5
"""By which poses may differ between devices, in [m] and as entries of rotations."""
ONE_RAY: Final = 1 / 128
"""V_f is counted with some 200 rays on a fruit: a difference below this is that of one ray."""
DIFFERENT_LOOKS: Final = 0.01
"""The share of looks that may differ by a ray."""


class PartFailure(Exception):
    """Something that must hold on every device does not."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """How much a part does."""

    device: str
    """`cpu` or `cuda`."""
    envs: tuple[int, ...]
    """Environments at once without a simulator."""
    shells: int
    """Environments at once in ManiSkill; on a CPU as many single ones, one after the other."""
    seconds: float
    """For one rate, and a thirtieth of what a training may take."""


def elapsed_per_call(work: Callable[[], object], setting: Setting, at_most: int = 10_000) -> float:
    """Seconds that a call takes, over calls for about `setting.seconds`; the first one is not counted.

    On CUDA it is wall time until the device is done; on a CPU, which may have other work, processor time.

    Args:
        work: What is called.
        setting: Where and for how long.
        at_most: Calls.
    """
    work()
    clock = _clock(setting.device)
    calls, start = 0, clock()
    while calls < at_most:
        work()
        calls += 1
        if clock(wait=False) - start >= setting.seconds:
            break
    return (clock() - start) / calls


def _clock(device: str) -> Callable[..., float]:
    def now(wait: bool = True) -> float:
        if device == "cpu":
            return time.process_time()
        if wait:
            torch.cuda.synchronize()
        return time.perf_counter()

    return now


def memory_mib(device: str) -> float:
    """Memory that is taken, in [MiB].

    On a GPU it is the most that PyTorch has held and what else is taken there, on a CPU this process's.
    """
    if device == "cpu":
        return round(resident_mib(), 1)
    free, whole = torch.cuda.mem_get_info()
    return round((whole - free - torch.cuda.memory_reserved() + torch.cuda.max_memory_allocated()) / MIB, 1)


def kernels(setting: Setting) -> Findings:
    """Plays a little, so that the parts after this one find the kernels compiled in Warp's cache."""
    for name, env_id in (("guided", GUIDED), ("general", GENERAL)):
        start = time.perf_counter()
        env = make_vector(env_id, 2, setting.device)
        env.step(torch.zeros(env.action_space.shape, device=setting.device))
        yield f"{name}_first_step_s", round(time.perf_counter() - start, 1)


def vector(setting: Setting) -> Findings:
    """Rates, memory and synchronisations of `gymnasium.make_vec`, with plants that were grown before."""
    growing = make_vector(GENERAL, 16, setting.device)
    for seed in range(4):
        growing.reset(seed=seed)
    growing.close()
    for name, env_id in (("guided", GUIDED), ("general", GENERAL)):
        for n in setting.envs:
            yield f"{name}_{n}", vector_row(env_id, n, setting)


def vector_row(env_id: str, n: int, setting: Setting) -> dict[str, Any]:
    """The same of one task and one number of environments."""
    if setting.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    started = time.perf_counter()
    env = make_vector(env_id, n, setting.device)
    made_s = time.perf_counter() - started
    moves = _moves(n, env.single_action_space.shape[0], setting.device)
    given = iter(range(10**9))
    step_s = elapsed_per_call(lambda: env.step(moves[next(given) % 64]), setting)
    reset_s = elapsed_per_call(env.reset, setting)
    step_waits = synchronisations(lambda: env.step(moves[0]), setting.device)
    reset_waits = synchronisations(env.reset, setting.device)
    env.close()
    return {
        "steps_per_s": four_digits(n / step_s),
        "resets_per_s": four_digits(n / reset_s),
        "made_s": round(made_s, 1),
        "memory_mib": memory_mib(setting.device),
        "synchronisations_a_step": sum(step_waits.values()),
        "synchronisations_a_reset_of_all": sum(reset_waits.values()),
        "where_a_step_waits": dict(step_waits),
    }


def agreement(setting: Setting) -> Findings:
    """Whether the device gives what the CPU gives: kinematics, V_f and whole episodes.

    On a CPU the rays of Warp are held against those of Embree, and batches against single poses.
    """
    rng = np.random.default_rng(0)
    qpos = torch.from_numpy(rng.uniform(-1.5, 1.5, (2000, 7)))
    poses = forward_kinematics(qpos)
    on_device = forward_kinematics(qpos.to(setting.device)).cpu()
    error = float((on_device - poses).abs().max())
    yield "forward_kinematics_largest_difference", error
    near = qpos + torch.from_numpy(rng.normal(0.0, 0.2, qpos.shape))
    solved = InverseKinematics().solve(poses, near)
    other = InverseKinematics(device=setting.device).solve(poses.to(setting.device), near.to(setting.device))
    found = solved.reach == int(Reach.REACHABLE)
    same = float((other.reach.cpu() == solved.reach).float().mean())
    missed = float((forward_kinematics(other.qpos.cpu()) - poses)[found].abs().max())
    yield "inverse_kinematics", {"same_reach": same, "largest_pose_error": missed}
    looks = different_looks(setting)
    yield "visible_fraction", looks
    episodes = {env_id: same_episodes(env_id, setting) for env_id in (GUIDED, GENERAL)}
    yield "same_episodes", episodes
    if max(error, missed) > POSE_TOLERANCE or same < 1.0:
        raise PartFailure(
            f"poses must agree to {POSE_TOLERANCE:g} and be reached alike; they differ by {max(error, missed):.3g}, "
            f"and {same:.2%} are reached alike"
        )
    if looks["differ"] > DIFFERENT_LOOKS or looks["largest_difference"] > ONE_RAY:
        raise PartFailure(
            f"V_f may differ by one ray in {DIFFERENT_LOOKS:.0%} of looks; it differs in {looks['differ']:.2%}, by "
            f"{looks['largest_difference']:.3g} at most"
        )


def different_looks(setting: Setting) -> dict[str, Any]:
    """Looks at plants from the CPU's poses, with its rays and with the device's: the share that differs in V_f."""
    world = make_world(GENERAL, 64, plant=POOL)
    scene = RayScene(
        world.plant_batch.plants,
        world.intrinsics,
        robot_meshes=link_meshes(),
        device=setting.device,
        backend="warp",
    )
    differences = []
    generator = torch.Generator().manual_seed(0)
    for turn in range(8):
        world.reset(seed=turn)
        scene.replace_plants(dict(enumerate(world.plant_batch.plants)))
        for _ in range(8):
            world.step(torch.randn(64, 3, generator=generator))
            view = (
                world.T_w_camera,
                world.state.target,
                world.plant_batch.T_world_plant,
                world.T_w_links,
            )
            here = world.scene.visibility(*view).visible_fraction.clone()
            there = scene.visibility(*(part.to(setting.device) for part in view)).visible_fraction.cpu()
            differences.append((here - there).abs())
    difference = torch.cat(differences)
    return {
        "looks": len(difference),
        "rays_here": world.scene.backend,
        "differ": float((difference > 0).float().mean()),
        "largest_difference": float(difference.max()),
    }


def same_episodes(env_id: str, setting: Setting) -> float:
    """The share of 64 environments whose first ten observations are those of the CPU, to a thousandth."""
    envs = [make_vector(env_id, 64, device) for device in ("cpu", setting.device)]
    shape = (10, *cast(tuple[int, ...], envs[0].action_space.shape))
    moves = torch.randn(shape, generator=torch.Generator().manual_seed(1)) * 0.1
    same = torch.ones(64, dtype=torch.bool)
    for move in moves:
        (one, *_), (two, *_) = (env.step(move.to(env.world.device)) for env in envs)
        same &= ((one.cpu() - two.cpu()).abs() < 1e-3).all(-1)
    return float(same.float().mean())


def shell(setting: Setting) -> Findings:
    """ManiSkill's shell with N environments: rates, resets of some of them, and states taken back."""
    env = Shells(GUIDED, setting.shells, setting.device, obs_mode="state", render_backend="none")
    with closing(env):
        first = env.reset(seed=0)
        moves = _moves(env.num_envs, 6, setting.device)
        step_s = elapsed_per_call(lambda: env.step(moves[0]), setting)
        yield "steps_per_s", four_digits(env.num_envs / step_s)
        reset_s = elapsed_per_call(env.reset, setting)
        yield "resets_per_s", four_digits(env.num_envs / reset_s)
        yield "memory_mib", memory_mib(setting.device)
        again = env.reset(seed=0)
        _must(torch.equal(first, again), "a seed must begin the same episodes again")
        kept = env.state()
        for move in moves[:3]:
            env.step(move)
        env.take_back(kept)
        largest = float((env.observation() - again).abs().max())
        yield "state_taken_back_largest_difference", largest
        _must(largest < 1e-4, "observations after a state was taken back must be those at which it was kept")
        moved = env.step(moves[3])
        some = list(range(0, env.num_envs, 2))
        others = [i for i in range(env.num_envs) if i not in some]
        before = env.elapsed_steps()[others].clone()
        reset = env.reset(rows=some)
        _must(torch.allclose(reset[others], moved[others], atol=1e-4), "a reset must leave others alone")
        elapsed = env.elapsed_steps()
        _must(not bool(elapsed[some].any()), "a reset must begin to count steps anew")
        _must(torch.equal(elapsed[others], before), "a reset must not touch the steps of others")
        yield "partial_resets", "as they should be"


def rendering(setting: Setting) -> Findings:
    """ManiSkill's shell with N environments and pictures of colour, depth and segmentation."""
    size = {"width": 128, "height": 128}
    mode = "rgb+depth+segmentation"
    backend = "gpu" if setting.device == "cuda" else "cpu"
    for name, env_id in (("guided", GUIDED), ("general", GENERAL)):
        # A seed of its own for each plant would build the scene anew at every reset.
        options: dict[str, Any] = {"plant": {"seed": 3}} if env_id == GENERAL else {}
        env = Shells(
            env_id,
            setting.shells,
            setting.device,
            obs_mode=mode,
            sensor_configs=size,
            render_backend=backend,
            **options,
        )
        with closing(env):
            seen = env.reset(seed=0)["sensor_data"]["d435"]
            shapes = {kind: list(picture.shape) for kind, picture in seen.items()}
            moves = _moves(env.num_envs, 6 if env_id == GUIDED else 3, setting.device)
            step_s = elapsed_per_call(lambda env=env, moves=moves: env.step(moves[0]), setting)  # type: ignore[misc]
            yield (
                name,
                {
                    "steps_per_s": four_digits(env.num_envs / step_s),
                    "shapes": shapes,
                    "memory_mib": memory_mib(setting.device),
                },
            )
            wanted = {kind: [setting.shells, 128, 128, c] for kind, c in _CHANNELS.items()}
            _must(shapes == wanted, f"pictures must have shapes {wanted}")
            rgb = seen["rgb"].float().flatten(1)
            _must(bool((rgb.std(dim=1) > 5).all()), "every environment's picture must show something")


_CHANNELS: Final = {"rgb": 3, "depth": 1, "segmentation": 1}


def fast_td3(setting: Setting) -> Findings:
    """One training by `fast-td3` on the guided task."""
    yield from _training("fast-td3", setting)


def pixels(setting: Setting) -> Findings:
    """One training from images by `pixel-td3` on the guided task."""
    yield from _training("pixel-td3", setting)


def _training(preset: PresetName, setting: Setting) -> Findings:
    config = replace(get_preset(preset), max_minutes=setting.seconds / 2.0)
    if setting.device == "cpu":
        # Enough updates in a short time, which a GPU's batches would not leave.
        config = replace(
            config,
            num_envs=min(config.num_envs, max(setting.envs)),
            learning_starts=128,
            batch_size=128,
            updates_per_step=max(config.updates_per_step, 1 / 32),
        )
    with tempfile.TemporaryDirectory() as folder:
        trained = train(GUIDED, config, Path(folder) / "run", 0, {}, show_progress=False)
        yield (
            "training",
            {
                "seconds": round(trained.seconds, 1),
                "steps": trained.steps,
                "updates": trained.updates,
                "steps_per_s": four_digits(trained.steps / trained.seconds),
                "updates_per_s": four_digits(trained.updates / trained.seconds),
                "memory_mib": memory_mib(setting.device),
                "ended": trained.stop_reason,
            },
        )
        _must(trained.updates > 0, "a training must update its networks within its time")
        env = make_env(GUIDED, 64)
        with closing(env):
            policy = open_policy(
                str(trained.policy_path), env_id=GUIDED, device=cast(Any, env.unwrapped).device
            )
            episodes = run_episodes(env, policy, 64, 10_000)
        yield "success_rate_of_64_episodes", sum(e.success for e in episodes) / len(episodes)


def segmenter(setting: Setting) -> Findings:
    """The light segmenter's network on the device, and the whole segmenter, which runs in ONNX on the CPU."""
    light = open_light()
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    yield "whole_look_on_the_cpu_ms", four_digits(1e3 * elapsed_per_call(lambda: light(image), setting, 200))
    x = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    reference = FruitSession(light.network)(x)
    network = light.network.to(setting.device)
    batch = x.to(setting.device)
    with torch.inference_mode():
        maps = network(batch)
        difference = max(
            float((one.cpu() - two).abs().max()) for one, two in zip(maps, reference, strict=True)
        )
        yield "network_largest_difference_from_onnx", difference
        for count in (1, 16):
            pictures = batch.expand(count, -1, -1, -1).contiguous()
            spent = elapsed_per_call(lambda pictures=pictures: network(pictures), setting, 200)  # type: ignore[misc]
            yield f"network_ms_an_image_batch_{count}", four_digits(1e3 * spent / count)
    _must(difference < 1e-2, "the network must say the same as in ONNX")


def gpu_tests(setting: Setting) -> Findings:
    """The tests that have the marker `gpu`; on a CPU those of them that take the device as a parameter."""
    files = sorted({str(p.relative_to(ROOT)) for p in ROOT.glob("tests/**/test_*.py") if _has_gpu(p)})
    chosen = ["-m", "gpu"] if setting.device == "cuda" else ["-k", "cpu", "-m", "not slow"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *chosen, *files]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    lines = done.stdout.strip().splitlines()
    counts = {
        word: int(n)
        for n, word in re.findall(r"(\d+) (passed|failed|skipped|error)", lines[-1] if lines else "")
    }
    yield "counts", counts
    yield "failed", [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    _must(done.returncode == 0 and counts.get("passed", 0) > 0, "tests must pass: " + "\n".join(lines[-3:]))


def profiles(setting: Setting) -> Findings:
    """Where the processor's time goes; `setting.seconds` scales how long the trainings are."""
    from dataclasses import asdict

    from benchmarking import profiles as paths

    found = list(paths.environment_profiles())
    yield "environments", [asdict(profile) for profile in found]
    yield "trainings", [asdict(p) for p in paths.training_profiles(max(600, int(4000 * setting.seconds)))]
    yield "deploy", [asdict(paths.deploy_profile(6))]
    if rendering_available():
        yield "look", [asdict(paths.look_profile(2))]


def _has_gpu(path: Path) -> bool:
    return "mark.gpu" in path.read_text()


def _moves(count: int, size: int, device: str) -> Tensor:
    """Small moves. Shape (64, N, A)."""
    moves = np.random.default_rng(0).uniform(-0.05, 0.05, (64, count, size)).astype(np.float32)
    return torch.from_numpy(moves).to(device)


def _must(holds: bool, rule: str) -> None:
    if not holds:
        raise PartFailure(rule)
