"""Policies by name and from files: what is opened, what is refused before anything heavy is imported, and adapters."""

import json
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato import extension_points
from maniskill_tomato.assets import asset_path
from maniskill_tomato.errors import PolicyError
from maniskill_tomato.learning.rl.export import export_policy
from maniskill_tomato.policies import registry
from maniskill_tomato.policies.adapters import BeliefFollower, ObservationPolicy, as_policy, as_state_policy
from maniskill_tomato.policies.baselines import Stay
from maniskill_tomato.policies.layout import EPSILON_GREEDY_HIGH, EPSILON_GREEDY_LOW
from maniskill_tomato.policies.opening import find_policy, open_policy, shipped_policy
from maniskill_tomato.policies.protocol import Policy
from maniskill_tomato.policies.trained_actor import load_actor
from maniskill_tomato.tasks import GENERAL_IDS, TASK_IDS, THESIS_IDS
from maniskill_tomato.tasks.vector_env import make_vector_env

GUIDED, GENERAL = THESIS_IDS[0], GENERAL_IDS[0]


class Twice:
    """A state policy, as anybody may write one."""

    def act(self, observations: Tensor) -> Tensor:
        return 2.0 * observations


def belief(observation: Tensor, visits: list[int] | None = None) -> Any:
    """As much of a belief as these policies look at."""
    return SimpleNamespace(
        observation=observation,
        camera_position=torch.zeros(len(observation), 3),
        memory=SimpleNamespace(visits=torch.tensor(visits or [])),
    )


# ------------------------------------------------------------------ by name


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nbw", "did you mean 'nbv'"),
        ("orcale", "did you mean 'oracle'"),
        ("missing.pt", r"no policy at 'missing.pt'; give a .pt or .onnx file, or one of random, stay"),
        ("", "no policy at ''"),
    ],
)
def test_an_unknown_name_lists_the_known_ones_and_the_nearest(name: str, words: str) -> None:
    with pytest.raises(PolicyError) as refused:
        open_policy(name)
    assert words in str(refused.value)


@pytest.mark.parametrize("name", registry.PRIVILEGED)
def test_a_policy_that_knows_the_truth_is_refused_without_it(name: str) -> None:
    with pytest.raises(
        PolicyError, match=f"{name} knows what no camera could tell; it runs in simulation only"
    ):
        open_policy(name, env_id=GENERAL)


@pytest.mark.parametrize("name", registry.PLANNERS)
def test_a_planner_is_refused_in_a_task_without_a_belief(name: str) -> None:
    with pytest.raises(PolicyError, match=f"{name} plans on a belief.*{GUIDED} has not"):
        open_policy(name, env_id=GUIDED)


def test_random_actions_are_those_of_the_task_and_their_seed_repeats_them() -> None:
    observations = torch.zeros(500, 9)
    first, again, other = (
        as_state_policy(open_policy("random", env_id=GUIDED, seed=s), SimpleNamespace(unwrapped=None)).act(
            observations
        )
        for s in (4, 4, 5)
    )
    torch.testing.assert_close(first, again)
    assert not torch.equal(first, other)
    low, high = torch.tensor(EPSILON_GREEDY_LOW), torch.tensor(EPSILON_GREEDY_HIGH)
    assert bool(((first >= low) & (first <= high)).all())
    torch.testing.assert_close(first.mean(dim=0), (low + high) / 2, atol=0.02, rtol=0.0)
    move = open_policy("random", env_id=GENERAL, seed=4).act(belief(torch.zeros(7, 786)))
    assert move.shape == (7, 3)
    torch.testing.assert_close(move.norm(dim=-1), torch.ones(7))


def test_another_package_adds_a_policy_by_an_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("mine", f"{__name__}:make_mine", registry.POLICIES.group)
    monkeypatch.setattr(
        extension_points, "entry_points", lambda group: [entry] if group == entry.group else []
    )
    assert "mine" in registry.policy_names() and find_policy("mine", GENERAL) == "mine"
    policy = open_policy("mine", env_id=GENERAL, seed=3)
    assert policy.act(belief(torch.zeros(2, 786))).tolist() == [[3.0] * 3] * 2
    with pytest.raises(PolicyError, match="did you mean 'mine'"):
        find_policy("mien")


def make_mine(context: registry.PolicyContext) -> Policy:
    class Mine(Stay):
        name = "mine"

        def act(self, belief: Any) -> Tensor:
            return super().act(belief) + context.seed

    return Mine()


# --------------------------------------------------------------- from files


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_the_shipped_policy_of_every_task_is_opened_for_it(env_id: str) -> None:
    policy = open_policy(shipped_policy(env_id), env_id=env_id)
    assert isinstance(policy, Policy) and not policy.needs_truth


def test_a_file_answers_observations_and_beliefs_alike_exported_or_not(tmp_path: Path) -> None:
    source = asset_path(f"policies/{GUIDED}.pt")
    observations = torch.randn(6, 9)
    wanted = load_actor(source).act(observations)
    for file in (source, export_policy(source, tmp_path).model):
        policy = open_policy(file, env_id=GUIDED)
        assert isinstance(policy, ObservationPolicy)
        policy.begin(belief(observations), torch.arange(6))
        for answer in (policy.act(belief(observations)), policy.act(observations)):
            torch.testing.assert_close(answer, wanted, atol=1e-5, rtol=0.0)
        assert policy.describe()["trained_on"] == GUIDED


def test_files_for_other_tasks_and_damaged_ones_are_refused(tmp_path: Path) -> None:
    torch.save({"format": "view-quality-99"}, tmp_path / "newer.pt")
    torch.save([1, 2], tmp_path / "list.pt")
    (tmp_path / "cut.pt").write_bytes(b"PK\x03\x04 nothing")
    (tmp_path / "alone.onnx").write_bytes(b"nothing")
    for file, env_id, words in (
        (asset_path(f"policies/{GUIDED}.pt"), THESIS_IDS[1], f"trained on {GUIDED}, not on {THESIS_IDS[1]}"),
        (asset_path("policies/deep_3dmts.pt"), GUIDED, f"a policy for {GENERAL}.*not for {GUIDED}"),
        (tmp_path / "newer.pt", None, "has format 'view-quality-99'; this version reads .*view-quality-3"),
        (tmp_path / "list.pt", None, "not a checkpoint of this package"),
        (tmp_path / "cut.pt", None, "not a readable checkpoint"),
        (tmp_path / "alone.onnx", None, "must stay together"),
    ):
        with pytest.raises(PolicyError, match=words):
            open_policy(file, env_id=env_id)


def test_names_and_files_are_checked_without_torch_or_the_simulator() -> None:
    program = """
import json, sys
from maniskill_tomato.errors import PolicyError
from maniskill_tomato.policies.opening import find_policy, shipped_policy
for name in ("nbv", "oracle", shipped_policy("TomatoViewpoint-v1")):
    find_policy(name, "TomatoViewpoint-v1")
for name in ("nbw", "missing.pt"):
    try:
        find_policy(name)
    except PolicyError:
        continue
    raise AssertionError(name)
heavy = ("torch", "mani_skill", "sapien", "warp", "onnxruntime")
print(json.dumps(sorted(set(heavy) & {m.partition(".")[0] for m in sys.modules})))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120
    )
    assert json.loads(done.stdout) == []


# ----------------------------------------------------------------- adapters


def test_any_state_policy_is_a_policy() -> None:
    policy = as_policy(Twice())
    assert isinstance(policy, Policy)
    assert policy.name == "Twice" and not policy.needs_truth
    assert policy.act(belief(torch.ones(2, 3))).tolist() == [[2.0] * 3] * 2
    stay = Stay()
    assert as_policy(stay) is stay


def test_a_policy_begins_where_the_memory_holds_one_view() -> None:
    class Recorder(Stay):
        def __init__(self) -> None:
            self.begun: list[list[int]] = []

        def begin(self, belief: Any, rows: Tensor) -> None:
            self.begun.append(rows.tolist())

    world = SimpleNamespace(keeps_belief=True, belief=belief(torch.zeros(3, 4), [1, 1, 1]))
    policy = Recorder()
    follower = as_state_policy(policy, SimpleNamespace(unwrapped=world))
    assert isinstance(follower, BeliefFollower)
    for visits in ([1, 1, 1], [2, 2, 2], [3, 1, 3]):
        world.belief = belief(torch.zeros(3, 4), visits)
        np.testing.assert_array_equal(follower.act(torch.zeros(3, 1)), np.zeros((3, 3)))
    assert policy.begun == [[0, 1, 2], [1]]


@pytest.mark.parametrize(
    ("task", "options", "fits"),
    [
        (GENERAL, {}, "pd_look_at"),
        (GENERAL, None, "pd_look_at"),
        (GUIDED, {"scene": "thesis"}, "pd_viewpoint"),
        (GENERAL, {"control_mode": "pd_ee_delta_pos"}, "pd_ee_delta_pos"),
    ],
)
def test_a_policy_acts_only_where_its_actions_mean_what_it_learned(
    task: str, options: dict[str, Any] | None, fits: str
) -> None:
    class Trained(Twice):
        def describe(self) -> dict[str, Any]:
            return {"kind": "TD3", "trained_on": task, "trained_with": options}

    policy = as_policy(Trained())
    for mode in ("pd_look_at", "pd_viewpoint", "pd_ee_delta_pos"):
        env = SimpleNamespace(unwrapped=SimpleNamespace(control_mode=mode))
        if mode == fits:
            as_state_policy(policy, env)
        else:
            with pytest.raises(PolicyError, match=f"control_mode='{fits}' and cannot act with '{mode}'"):
                as_state_policy(policy, env)


def test_worlds_and_their_vectors_tell_what_an_action_is() -> None:
    for env_id, mode in ((GUIDED, "pd_viewpoint"), (GENERAL, "pd_look_at")):
        assert make_vector_env(env_id).control_mode == mode


def test_a_policy_that_needs_a_belief_says_so_where_there_is_none() -> None:
    env = SimpleNamespace(unwrapped=SimpleNamespace())
    with pytest.raises(PolicyError, match="stay decides from beliefs"):
        as_state_policy(Stay(), env)
    twice = Twice()
    assert as_state_policy(as_policy(twice), env) is twice
