"""Policies away from the trainer: exported files, their descriptions, and what is refused."""

import hashlib
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray
from onnx import helper
from onnx.reference import ReferenceEvaluator
from torch import nn

import maniskill_tomato
from maniskill_tomato.assets import asset_path
from maniskill_tomato.cli import main
from maniskill_tomato.errors import CheckpointError, InvalidInputError, PolicyError
from maniskill_tomato.experiments.rollout import run_episodes
from maniskill_tomato.files import write_tensors
from maniskill_tomato.learning.rl.agent import make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.dense_actor import DenseActor
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.export import export_actor, export_policy
from maniskill_tomato.learning.rl.presets import PRESETS, TrainConfig, get_preset
from maniskill_tomato.learning.rl.rounding import rounding_tolerance
from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.policies.adapters import ObservationPolicy, origin
from maniskill_tomato.policies.description import INPUT_NAME, PolicyDescription
from maniskill_tomato.policies.onnx_policy import OnnxPolicy
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.trained_actor import load_actor
from maniskill_tomato.sensing.observation import ObservationLayout
from maniskill_tomato.tasks import THESIS_IDS

GUIDED, SPARSE = THESIS_IDS
CENTRE = np.array([0.2, 0.0, 0.8, 0.0, np.pi / 2, 0.0, 0.7, 0.0, 0.8])
"""A usual observation: the camera looks along x, the target stands in front of it."""

Float32 = NDArray[np.float32]


def make_policy(path: Path, preset: str = "td3", bound: float = 1.0, gain: float = 1.0) -> Path:
    """An untrained policy whose output weights are `gain` times their initial values."""
    torch.manual_seed(7)
    agent = make_agent(get_preset(preset), 9, 6)
    with torch.no_grad():
        agent.actor.output.weight *= gain
    bounds = (-bound * torch.ones(6), bound * torch.ones(6))
    write_tensors(path, make_checkpoint(agent, GUIDED, bounds, {"steps": 12, "episodes": 2, "seed": 3}))
    return path


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    """The ONNX file of an untrained policy, its description beside it."""
    return export_policy(make_policy(tmp_path / "policy.pt", gain=100.0), tmp_path).model


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Changes the description beside the ONNX file `path`."""
    content = json.loads(path.with_suffix(".json").read_text())
    change(content)
    path.with_suffix(".json").write_text(json.dumps(content))


def edges() -> Float32:
    """Observations that a task or an arm can just about bring, and some that none can."""
    rows = [np.zeros(9), CENTRE, -CENTRE, np.full(9, 1e-40), np.full(9, -0.0)]
    rows += [CENTRE + sign * np.pi * axis for axis in np.eye(9) for sign in (-1.0, 1.0)]
    rows += [np.where(np.arange(9) % 2 == parity, 5.0, -5.0) for parity in (0, 1)]
    return np.stack(rows).astype(np.float32)


def exact(path: Path, observations: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """What an ONNX file says with every number in float64, so that no processor's rounding enters. Shape (B, A)."""
    model = onnx.load(path)
    for constant in model.graph.initializer:
        constant.CopyFrom(
            onnx.numpy_helper.from_array(
                onnx.numpy_helper.to_array(constant).astype(np.float64), constant.name
            )
        )
    for end in (*model.graph.input, *model.graph.output):
        end.type.tensor_type.elem_type = onnx.TensorProto.DOUBLE
    (actions,) = ReferenceEvaluator(model).run(None, {INPUT_NAME: observations.astype(np.float64)})
    return np.asarray(actions, dtype=np.float64)


def exact_torch(path: Path, observations: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """What the policy file NAME.pt says with every number in float64. Shape (B, A)."""
    policy = load_actor(path)
    parts = {name: getattr(policy, name).double() for name in ("action_scale", "action_low", "action_high")}
    double = replace(policy, actor=policy.actor.double(), normalizer=policy.normalizer.double(), **parts)
    return double.act(torch.from_numpy(observations).double()).numpy()


def actor_of(path: Path) -> DenseActor:
    """The parts of the policy file NAME.pt."""
    policy = load_actor(path)
    return DenseActor(
        act=policy.act,
        normalizer=policy.normalizer,
        normalizer_kind="fixed",
        layers=[*policy.actor.hidden, policy.actor.output],
        activation="Relu",
        output="Tanh",
        action_scale=policy.action_scale,
        action_low=policy.action_low,
        action_high=policy.action_high,
        env_id=policy.env_id,
        env_options=None,
        package_version="9",
        algorithm="TD3",
        counters={},
        config={},
    )


def assert_acts_alike(model: Path, source: Path, observations: Float32) -> None:
    """The file is the policy of `source` in float64, and ONNX Runtime's float32 differs by rounding alone."""
    reference = exact_torch(source, observations)
    np.testing.assert_allclose(exact(model, observations), reference, rtol=0.0, atol=1e-10)
    actions = OnnxPolicy.load(model).act(observations)
    assert actions.dtype == np.float32
    assert (np.abs(actions - reference) <= rounding_tolerance(actor_of(source), observations)).all()


def summed_one_by_one(actor: DenseActor, observations: torch.Tensor) -> torch.Tensor:
    """The actor's answer as a processor without vector units calculates it: float32, product by product."""
    x = ((observations - actor.normalizer.centre) / actor.normalizer.half_range).numpy()
    layers: Any = actor.layers
    for index, layer in enumerate(layers):
        weight, bias = (p.detach().numpy() for p in (layer.weight, layer.bias))
        total = np.zeros((len(x), len(bias)), np.float32)
        for column in range(weight.shape[1]):
            total += x[:, column : column + 1] * weight[:, column]
        total += bias
        x = np.tanh(total) if index == len(layers) - 1 else np.maximum(total, 0.0)
    return torch.from_numpy(x) * actor.action_scale


def test_rounding_of_an_actor_with_large_weights_does_not_refuse_its_export(tmp_path: Path) -> None:
    actor = actor_of(make_policy(tmp_path / "p.pt", "thesis-guided", gain=1000.0))
    result = export_actor(replace(actor, act=lambda o: summed_one_by_one(actor, o)), tmp_path / "p.onnx")
    assert result.largest_difference > 1e-5  # More than a tolerance that knows nothing of the weights allows.


@pytest.mark.parametrize("layer", [0, 1, 2])
@pytest.mark.parametrize("gain", [1.0, 30.0])
def test_an_export_with_one_wrong_weight_is_refused(tmp_path: Path, layer: int, gain: float) -> None:
    actor = actor_of(make_policy(tmp_path / "p.pt", "thesis-guided", gain=gain))
    other: Any = actor_of(tmp_path / "p.pt").layers
    with torch.no_grad():
        row, column = divmod(int(other[layer].weight.abs().argmax()), other[layer].weight.shape[1])
        other[layer].weight[row, column] *= 1.02
    with pytest.raises(PolicyError, match="more than float32 rounds; nothing was written"):
        export_actor(replace(actor, layers=other), tmp_path / "p.onnx")
    assert not list(tmp_path.glob("*.onnx"))


@pytest.mark.parametrize("preset", [name for name in PRESETS if not name.startswith(("general-", "pixel-"))])
def test_an_export_acts_as_the_policy_does_in_torch(tmp_path: Path, preset: str) -> None:
    source = make_policy(tmp_path / "policy.pt", preset, gain=30.0)
    result = export_policy(source, tmp_path / "out")
    random = np.random.default_rng(1).uniform(-2.0, 2.0, (2000, 9)).astype(np.float32)
    for observations in (random, edges()):
        assert_acts_alike(result.model, source, observations)
        actions = OnnxPolicy.load(result.model).act(observations)
        assert np.abs(actions).max() > 0.05  # Otherwise a policy that does nothing would pass.


@pytest.mark.parametrize("env_id", THESIS_IDS)
def test_the_shipped_policies_act_alike_when_exported(tmp_path: Path, env_id: str) -> None:
    source = asset_path(f"policies/{env_id}.pt")
    model = export_policy(source, tmp_path).model
    random = np.random.default_rng(2).normal(CENTRE, 0.7, (5000, 9)).astype(np.float32)
    for observations in (random, edges()):
        assert_acts_alike(model, source, observations)


def test_an_export_follows_a_calculation_by_hand(tmp_path: Path) -> None:
    config = TrainConfig(
        total_timesteps=1,
        actor_hidden=(2,),
        action_scale=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
        normalize_observations="fixed",
    )
    agent = make_agent(config, 9, 6)
    with torch.no_grad():
        for parameter in agent.actor.parameters():
            parameter.zero_()
        hidden: Any = agent.actor.hidden[0]
        hidden.weight[0, 0] = 1.0  # Unit 0 sees ee_x, unit 1 minus the target's y.
        hidden.weight[1, 7] = -1.0
        agent.actor.output.weight[0, 0] = 2.0
        agent.actor.output.weight[5, 1] = 1.0
        agent.actor.output.bias[2] = 100.0
    bounds = (-0.25 * torch.ones(6), 0.25 * torch.ones(6))
    write_tensors(tmp_path / "p.pt", make_checkpoint(agent, GUIDED, bounds, {}))
    policy = OnnxPolicy.load(export_policy(tmp_path / "p.pt", tmp_path).model)
    observation = CENTRE.copy()
    observation[0] = 0.45  # Half of ee_x's half range of 0.5 above its centre.
    observation[7] = -0.5
    (action,) = policy.act(observation[None])
    # tanh(2 * 0.5) * 0.1; dz saturates at 0.3 and dyaw at tanh(1) * 0.6 = 0.457, both above the bound.
    np.testing.assert_allclose(action, [0.1 * np.tanh(1.0), 0.0, 0.25, 0.0, 0.0, 0.25], rtol=0.0, atol=1e-6)


def test_a_running_normaliser_is_exported_as_it_was_last(tmp_path: Path) -> None:
    config = replace(PRESETS["td3"], normalize_observations="running")
    agent = make_agent(config, 9, 6)
    seen = torch.randn(500, 9, generator=torch.Generator().manual_seed(0)) * 0.2 + torch.tensor(
        CENTRE.tolist()
    )
    agent.observe(seen)
    with torch.no_grad():
        agent.actor.output.weight.mul_(100.0)
    bounds = (-torch.ones(6), torch.ones(6))
    write_tensors(tmp_path / "p.pt", make_checkpoint(agent, GUIDED, bounds, {}, with_training_state=False))
    model = export_policy(tmp_path / "p.pt", tmp_path / "out").model
    content = json.loads(model.with_suffix(".json").read_text())["normalizer"]
    assert content["kind"] == "running"
    np.testing.assert_allclose(content["centre"], seen.double().mean(dim=0), rtol=1e-5)
    np.testing.assert_allclose(content["half_range"], seen.double().std(dim=0, correction=0), rtol=1e-5)
    assert_acts_alike(model, tmp_path / "p.pt", seen.numpy())
    assert np.abs(OnnxPolicy.load(model).act(seen.numpy())).max() > 0.05


def test_a_description_that_does_not_say_where_its_normaliser_comes_from_is_read(exported: Path) -> None:
    text = exported.with_suffix(".json").read_text()
    content = json.loads(text)
    assert PolicyDescription.from_json(text).normalizer_kind == content["normalizer"].pop("kind") == "fixed"
    assert PolicyDescription.from_json(json.dumps(content)).normalizer_kind == "unknown"


def make_foreign_actor(act: Callable[[torch.Tensor], torch.Tensor], weights: list[Any]) -> DenseActor:
    """A policy of another learner: tanh layers and a clipped output."""
    layers = []
    for weight, bias in weights:
        layers.append(nn.Linear(weight.shape[1], weight.shape[0]))
        layers[-1].weight.data = torch.tensor(weight, dtype=torch.float32)
        layers[-1].bias.data = torch.tensor(bias, dtype=torch.float32)
    return DenseActor(
        act=act,
        normalizer=ObservationNormalizer([0.5] * 9, [2.0] * 9),
        normalizer_kind="fixed",
        layers=layers,
        activation="Tanh",
        output="Clip",
        action_scale=torch.full((6,), 0.4),
        action_low=torch.full((6,), -0.3),
        action_high=torch.ones(6),
        env_id=SPARSE,
        env_options={"plant": "full"},
        package_version="9",
        algorithm="PPO",
        counters={"steps": 7},
        config={"n_steps": 500},
    )


def test_policies_of_other_learners_can_be_exported(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    weights = [
        (rng.normal(size=(12, 9)), rng.normal(size=12)),
        (rng.normal(size=(6, 12)), rng.normal(size=6)),
    ]

    def by_hand(observations: torch.Tensor) -> torch.Tensor:
        x = (observations.numpy() - 0.5) / 2.0
        x = np.tanh(x @ weights[0][0].T + weights[0][1])
        x = np.clip(x @ weights[1][0].T + weights[1][1], -1.0, 1.0)
        return torch.from_numpy(np.clip(0.4 * x, -0.3, 1.0))

    result = export_actor(make_foreign_actor(by_hand, weights), tmp_path / "out" / "ppo.onnx")
    policy = OnnxPolicy.load(result.model, SPARSE)
    observations = rng.normal(size=(200, 9))
    reference = by_hand(torch.from_numpy(observations)).numpy()
    assert (np.unique(reference).size > 100) and {-0.3, 0.4} <= set(np.unique(reference))
    np.testing.assert_allclose(policy.act(observations), reference, rtol=0.0, atol=1e-5)
    assert policy.description.training == {
        "algorithm": "PPO",
        **{"seed": None, "steps": 7, "episodes": None, "updates": None},
        "config_sha256": hashlib.sha256(b'{"n_steps": 500}').hexdigest(),
    }
    other = make_foreign_actor(lambda o: by_hand(o) + 1e-3, weights)
    with pytest.raises(PolicyError, match="differ by 1"):
        export_actor(other, tmp_path / "other.onnx")
    assert not list(tmp_path.glob("other.*"))


def test_a_batch_of_any_size_is_answered_row_by_row(exported: Path) -> None:
    policy = OnnxPolicy.load(exported)
    observations = np.random.default_rng(3).normal(CENTRE, 0.5, (17, 9)).astype(np.float32)
    one_by_one = np.concatenate([policy.act(row[None]) for row in observations])
    # A matrix times a vector rounds otherwise than times a matrix.
    tolerance = rounding_tolerance(actor_of(exported.with_suffix(".pt")), observations)
    assert (np.abs(policy.act(observations) - one_by_one) <= tolerance).all() and tolerance.max() < 1e-3
    assert policy.act(np.zeros((0, 9), np.float32)).shape == (0, 6)
    np.testing.assert_array_equal(policy.act(observations[:, ::-1][:, ::-1]), policy.act(observations))
    np.testing.assert_array_equal(policy.act(observations.tolist()), policy.act(observations))


def test_huge_observations_still_give_actions_within_the_scale(exported: Path) -> None:
    actions = OnnxPolicy.load(exported).act(np.array([[1e6] * 9, [-1e6] * 9]))
    assert (np.abs(actions) <= np.array([0.35] * 3 + [0.6] * 3, np.float32)).all()


def test_the_same_policy_gives_the_same_files(tmp_path: Path) -> None:
    source = make_policy(tmp_path / "policy.pt")
    first, second = (export_policy(source, tmp_path / name) for name in ("a", "b"))
    assert first.model.read_bytes() == second.model.read_bytes()
    assert first.description.read_bytes() == second.description.read_bytes()


def test_the_description_says_what_the_numbers_mean(exported: Path) -> None:
    content = json.loads(exported.with_suffix(".json").read_text())
    assert content["package_version"] == maniskill_tomato.__version__
    assert content["task"]["id"] == GUIDED and content["task"]["success_threshold"] == 0.85
    plant = content["task"]["default_plant"]
    assert (plant["preset"], plant["seed"], plant["pose"]) == (
        "one_tomato",
        1,
        {"x": 0.85, "y": 0.2, "yaw": 0.0},
    )
    observed = [(c["name"], c["unit"]) for c in content["observation"]["components"]]
    assert (
        observed[0] == ("ee_x", "m")
        and observed[4] == ("ee_pitch", "rad")
        and observed[8] == ("target_z", "m")
    )
    np.testing.assert_allclose(content["normalizer"]["centre"], CENTRE, atol=1e-6)
    assert content["normalizer"]["half_range"] == [0.5] * 3 + [1.0] * 3 + [0.5] * 3
    done = content["action"]["components"]
    assert done[1] == {"name": "dy", "unit": "m", "low": -1.0, "high": 1.0, "scale": 0.35}
    assert done[5] == {"name": "dyaw", "unit": "rad", "low": -1.0, "high": 1.0, "scale": 0.6}
    training = content["training"]
    assert (training["algorithm"], training["seed"], training["steps"]) == ("TD3", 3, 12)
    assert content["onnx"]["sha256"] == hashlib.sha256(exported.read_bytes()).hexdigest()


def test_the_description_says_what_plant_the_training_had(tmp_path: Path) -> None:
    agent = make_agent(get_preset("td3"), 9, 6)
    bounds = (-torch.ones(6), torch.ones(6))
    options = {"plant": {"preset": "full"}, "plant_pose": (0.8, 0.1, 0.5)}
    lines = []
    for given in (options, {}, None):
        write_tensors(tmp_path / "p.pt", make_checkpoint(agent, GUIDED, bounds, {}, env_options=given))
        model = export_policy(tmp_path / "p.pt", tmp_path).model
        kept = None if given is None else json.loads(json.dumps(given))
        content = json.loads(model.with_suffix(".json").read_text())
        assert content["task"]["trained_with"] == kept
        assert content["task"]["default_plant"]["preset"] == "one_tomato"
        policy = open_policy(model)
        assert isinstance(policy, ObservationPolicy) and policy.describe()["trained_with"] == kept
        lines.append(origin(policy))
        assert origin(open_policy(tmp_path / "p.pt")) == lines[-1].replace("TD3, ONNX", "TD3")
    assert lines == [
        f'TD3, ONNX, trained on {GUIDED} with plant={{"preset": "full"}}, plant_pose=[0.8, 0.1, 0.5]',
        f"TD3, ONNX, trained on {GUIDED} with the task's own plant and options",
        f"TD3, ONNX, trained on {GUIDED} with options that its file does not say",
    ]


def test_a_description_of_an_earlier_version_still_loads(exported: Path) -> None:
    edit(exported, lambda content: content["task"].pop("trained_with"))
    assert OnnxPolicy.load(exported).description.trained_with is None


def test_the_configuration_hash_tells_configurations_apart(tmp_path: Path) -> None:
    hashes = []
    for preset in ("thesis-guided", "thesis-sparse", "thesis-guided"):
        result = export_policy(make_policy(tmp_path / "policy.pt", preset), tmp_path)
        hashes.append(json.loads(result.description.read_text())["training"]["config_sha256"])
    assert hashes[0] == hashes[2] != hashes[1]


def test_loading_and_acting_need_neither_torch_nor_the_simulator(exported: Path) -> None:
    """Their imports are made to fail, as on a machine that lacks them."""
    program = f"""
import json, sys
FORBIDDEN = {{"torch", "mani_skill", "sapien", "warp", "mujoco", "mink", "cv2", "onnx", "matplotlib", "tyro"}}
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in FORBIDDEN or name.startswith("maniskill_tomato.learning"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Missing())
import numpy as np
from maniskill_tomato.policies.onnx_policy import OnnxPolicy
actions = OnnxPolicy.load({str(exported)!r}).act(np.array([{CENTRE.tolist()}], np.float32))
loaded = [m for m in sys.modules if m.partition(".")[0] in FORBIDDEN or m.startswith("maniskill_tomato.")]
print(json.dumps([actions.tolist(), sorted(loaded)]))
"""
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300
    )
    actions, loaded = json.loads(result.stdout)
    source, observation = exported.with_suffix(".pt"), CENTRE[None].astype(np.float32)
    tolerance = rounding_tolerance(actor_of(source), observation)
    assert (np.abs(np.array(actions) - exact_torch(source, observation)) <= tolerance).all()
    assert loaded == [
        "maniskill_tomato.errors",
        "maniskill_tomato.extension_points",
        "maniskill_tomato.plants",
        "maniskill_tomato.plants.organs",
        "maniskill_tomato.policies",
        "maniskill_tomato.policies.description",
        "maniskill_tomato.policies.layout",
        "maniskill_tomato.policies.onnx_policy",
        "maniskill_tomato.sensing",
        "maniskill_tomato.sensing.image_layout",
        "maniskill_tomato.sensing.perception_kinds",
        "maniskill_tomato.task_registry",
        "maniskill_tomato.tasks",
        "maniskill_tomato.tasks.registration",
        "maniskill_tomato.text_files",
    ]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e300])
def test_observations_that_are_not_finite_are_refused_by_name(exported: Path, value: float) -> None:
    observations = np.stack((CENTRE, CENTRE))
    observations[1, 4] = value
    with pytest.raises(InvalidInputError, match="must be finite; ee_pitch of observation 1 is"):
        OnnxPolicy.load(exported).act(observations)


@pytest.mark.parametrize("shape", [(9,), (1, 8), (1, 10), (1, 1, 9), ()])
def test_observations_of_another_shape_are_refused(exported: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInputError, match=r"shape \(B, 9\), got"):
        OnnxPolicy.load(exported).act(np.zeros(shape, np.float32))


@pytest.mark.parametrize("values", [[["a"] * 9], [[1j] * 9], [[None] * 9], [[True] * 9]])
def test_observations_that_are_not_real_numbers_are_refused(exported: Path, values: Any) -> None:
    with pytest.raises(InvalidInputError, match="must be real numbers"):
        OnnxPolicy.load(exported).act(values)


@pytest.mark.parametrize("ending", [".onnx", ".json"])
def test_a_missing_file_is_named(exported: Path, ending: str) -> None:
    exported.with_suffix(ending).unlink()
    with pytest.raises(PolicyError, match=rf"cannot read the .*policy\{ending}.*must stay together"):
        OnnxPolicy.load(exported)


def test_the_description_is_not_the_file_to_load(exported: Path) -> None:
    with pytest.raises(PolicyError, match="is a description; give the ONNX file"):
        OnnxPolicy.load(exported.with_suffix(".json"))


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_a_truncated_model_is_refused(exported: Path, share: float) -> None:
    content = exported.read_bytes()
    exported.write_bytes(content[: int(share * len(content))])
    with pytest.raises(PolicyError, match="SHA-256 differ"):
        OnnxPolicy.load(exported)


def test_one_changed_bit_of_the_weights_is_noticed(exported: Path) -> None:
    content = bytearray(exported.read_bytes())
    content[len(content) // 2] ^= 1
    exported.write_bytes(bytes(content))
    with pytest.raises(PolicyError, match="SHA-256 differ"):
        OnnxPolicy.load(exported)


def test_files_of_two_policies_are_not_mixed(tmp_path: Path) -> None:
    a = export_policy(make_policy(tmp_path / "a.pt"), tmp_path)
    b = export_policy(make_policy(tmp_path / "b.pt", gain=2.0), tmp_path)
    a.description.write_bytes(b.description.read_bytes())
    with pytest.raises(PolicyError, match="belongs to another policy"):
        OnnxPolicy.load(a.model)


@pytest.mark.parametrize("text", ["", "{", "[1]", "7", '{"format": "1"}', "\xff\xfe", '{"format": 1}'])
def test_a_damaged_description_is_refused(exported: Path, text: str) -> None:
    exported.with_suffix(".json").write_text(text, encoding="latin-1")
    with pytest.raises(PolicyError, match=r"policy\.json cannot be used"):
        OnnxPolicy.load(exported)


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        (("format",), 99, "format 99.*upgrade"),
        (("task", "id"), 5, "5 is not text"),
        (("normalizer", "centre"), [0.0] * 8, "9 centres"),
        (("normalizer", "centre"), [0.0] * 8 + ["0"], "'0' is not a finite number"),
        (("action", "components", 0, "scale"), None, "None is not a finite number"),
        (("action", "components", 0, "unit"), "mm", r"dx \[mm\].*export the policy with this version"),
        (("observation", "components", 0, "name"), "ee_y", r"its observation is ee_y \[m\], ee_y"),
        (("observation", "components"), [], "its observation is ;"),
        (("training",), 3, "wrong type"),
    ],
)
def test_a_description_that_cannot_be_right_is_refused(
    exported: Path, entry: tuple[str | int, ...], value: Any, message: str
) -> None:
    def change(content: Any) -> None:
        for key in entry[:-1]:
            content = content[key]
        content[entry[-1]] = value

    edit(exported, change)
    with pytest.raises(PolicyError, match=message):
        OnnxPolicy.load(exported)


@pytest.mark.parametrize("damage", ["not a model", "another width"])
def test_a_described_file_that_is_no_such_policy_is_refused(exported: Path, damage: str) -> None:
    content = b"not a model"
    if damage == "another width":
        observation, action = (
            helper.make_tensor_value_info(n, 1, ["batch", 9]) for n in ("observation", "action")
        )
        node = helper.make_node("Relu", ["observation"], ["action"])
        graph = helper.make_graph([node], "g", [observation], [action])
        opset = [helper.make_opsetid("", 17)]
        content = helper.make_model(graph, opset_imports=opset, ir_version=8).SerializeToString()
    exported.write_bytes(content)
    edit(exported, lambda c: c["onnx"].update(sha256=hashlib.sha256(content).hexdigest()))
    with pytest.raises(PolicyError, match="export` again"):
        OnnxPolicy.load(exported)


def test_a_policy_whose_answer_is_not_finite_is_refused(exported: Path) -> None:
    model = onnx.load_from_string(exported.read_bytes())
    (bias,) = (t for t in model.graph.initializer if t.name == "hidden_0.bias")
    bias.CopyFrom(onnx.numpy_helper.from_array(np.full(128, np.nan, np.float32), bias.name))
    content = model.SerializeToString()
    exported.write_bytes(content)
    edit(exported, lambda c: c["onnx"].update(sha256=hashlib.sha256(content).hexdigest()))
    with pytest.raises(PolicyError, match="not finite; the arm must not move"):
        OnnxPolicy.load(exported).act(CENTRE[None])


def test_a_policy_of_another_task_is_refused_unless_any_will_do(exported: Path) -> None:
    with pytest.raises(PolicyError, match=f"trained on {GUIDED}, not on {SPARSE}"):
        OnnxPolicy.load(exported, SPARSE)
    assert OnnxPolicy.load(exported, GUIDED).description.env_id == GUIDED


def test_a_policy_of_another_layout_is_not_exported(tmp_path: Path) -> None:
    agent = make_agent(get_preset("td3"), 9, 6)
    data = make_checkpoint(agent, GUIDED, (-torch.ones(6), torch.ones(6)), {})
    data["observation"]["names"] = data["observation"]["names"][::-1]
    write_tensors(tmp_path / "p.pt", data)
    with pytest.raises(PolicyError, match="cannot be exported: its observation is target_z"):
        export_policy(tmp_path / "p.pt", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_actor_that_the_export_does_not_know_is_not_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = make_policy(tmp_path / "p.pt", gain=100.0)
    monkeypatch.setattr("maniskill_tomato.policies.actor.torch.relu", torch.nn.functional.gelu)
    with pytest.raises(PolicyError, match="ONNX Runtime and PyTorch differ by .* nothing was written"):
        export_policy(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_export_that_cannot_be_written_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = make_policy(tmp_path / "p.pt")
    (tmp_path / "file").write_text("in the way")
    for out in (tmp_path / "file", tmp_path / "file/below"):
        with pytest.raises(InvalidInputError, match="cannot be a folder .*choose another --out"):
            export_policy(source, out)

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(CheckpointError, match="No space left on device"):
        export_policy(source, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_the_command_exports_the_shipped_policies_or_a_given_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["export", "--out", str(tmp_path / "shipped")])
    written = {path.name for path in (tmp_path / "shipped").iterdir()}
    assert written == {f"{env_id}.{ending}" for env_id in THESIS_IDS for ending in ("onnx", "json")}
    for env_id in THESIS_IDS:
        assert OnnxPolicy.load(tmp_path / f"shipped/{env_id}.onnx").description.env_id == env_id
    make_policy(tmp_path / "policy.pt")
    main(["export", "--policy", str(tmp_path / "policy.pt"), "--out", str(tmp_path)])
    assert f"model       {tmp_path / 'policy.onnx'}" in capsys.readouterr().out
    assert OnnxPolicy.load(tmp_path / "policy.onnx").description.training["seed"] == 3


def test_the_command_answers_bad_files_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.pt").write_text("hello")
    (tmp_path / "bad.onnx").write_text("hello")
    for arguments, message in (
        (("export", "--policy", str(tmp_path / "no.pt")), "--policy: there is no file"),
        (("export", "--policy", str(tmp_path / "bad.pt")), "not a readable checkpoint"),
        (("eval", GUIDED, "--policy", str(tmp_path / "no.onnx")), "--policy: no policy at"),
        (("eval", GUIDED, "--policy", str(tmp_path / "bad.onnx")), "cannot read the description"),
    ):
        with pytest.raises(SystemExit) as ended:
            main([*arguments, "--out", str(tmp_path / "out")])
        assert ended.value.code == 2
        said = capsys.readouterr().err
        assert said.startswith("error: ") and message in said and "Traceback" not in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("env_id", THESIS_IDS)
def test_an_exported_policy_has_the_same_episodes_as_its_source(tmp_path: Path, env_id: str) -> None:
    source = asset_path(f"policies/{env_id}.pt")
    target = export_policy(source, tmp_path).model
    env = make_env(env_id)
    try:
        ours, theirs = (
            run_episodes(env, open_policy(path, env_id=env_id), 6, 40) for path in (source, target)
        )
    finally:
        env.close()
    for a, b in zip(ours, theirs, strict=True):
        assert (a.seed, a.success, a.steps) == (b.seed, b.success, b.steps)
        np.testing.assert_allclose(a.viewpoints, b.viewpoints, rtol=0.0, atol=1e-4)
        # A ray of the 256 may meet another triangle when the pose moves by a rounding error.
        np.testing.assert_allclose(a.visible_fraction, b.visible_fraction, rtol=0.0, atol=0.02)


def test_an_exported_policy_is_evaluated_by_the_command(tmp_path: Path) -> None:
    main(["export", "--out", str(tmp_path)])
    policy = str(tmp_path / f"{GUIDED}.onnx")
    out = ("--out", str(tmp_path / "eval"))
    main(["eval", GUIDED, "--policy", policy, "--episodes", "5", "--no-video", "--no-baseline", *out])
    metrics = json.loads((tmp_path / "eval/metrics.json").read_text())
    assert metrics["success_rate"] == 1.0 and metrics["mean_steps"] <= 3.0
    described = metrics["policy"]
    assert described["path"] == policy and described["trained_on"] == GUIDED
    assert (described["kind"], described["training_seed"]) == ("TD3, ONNX", 0)


def test_a_policy_of_the_general_task_is_exported_with_its_own_layout(tmp_path: Path) -> None:
    size = ObservationLayout().size
    torch.manual_seed(1)
    agent = make_agent(get_preset("general-td3"), size, 3)
    with torch.no_grad():
        agent.actor.output.weight *= 100.0
    bounds = (-torch.ones(3), torch.ones(3))
    counters: dict[str, int | float] = {"steps": 12, "episodes": 2, "seed": 3}
    write_tensors(tmp_path / "p.pt", make_checkpoint(agent, "TomatoViewpoint-v1", bounds, counters))
    model = export_policy(tmp_path / "p.pt", tmp_path).model
    exported = OnnxPolicy.load(model, "TomatoViewpoint-v1")
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, (5, size)).astype(np.float32)
    assert_acts_alike(model, tmp_path / "p.pt", observations)
    assert np.abs(exported.act(observations)).max() > 0.1
    assert [c.name for c in exported.description.action] == ["right", "up", "forward"]
    assert len(exported.description.observation) == size


def test_a_policy_of_another_observation_than_the_tasks_cannot_be_exported(tmp_path: Path) -> None:
    agent = make_agent(get_preset("general-td3"), ObservationLayout.blind().size, 3)
    bounds = (-torch.ones(3), torch.ones(3))
    write_tensors(tmp_path / "p.pt", make_checkpoint(agent, "TomatoViewpoint-v1", bounds, {}))
    with pytest.raises(PolicyError, match="786 values"):
        export_policy(tmp_path / "p.pt", tmp_path)
