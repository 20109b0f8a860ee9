"""What other packages add: found by their entry points, used by commands and options, and refused with a reason.

The package is that of `examples/make_it_yours`, built and installed outside of the repository.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from maniskill_tomato.cli import main
from maniskill_tomato.errors import InvalidInputError, PolicyError
from maniskill_tomato.experiments.policy_runs import PolicySpec
from maniskill_tomato.extension_points import ExtensionPoint, is_import_path
from maniskill_tomato.learning.rl.gymnasium_env import make_gymnasium_env, normalize_observation
from maniskill_tomato.learning.rl.sb3_policy import sb3_policy
from maniskill_tomato.plants.spec import PlantSpec
from maniskill_tomato.policies.opening import find_policy, open_policy
from maniskill_tomato.segmentation.segmenter import make_segmenter, open_for_files
from maniskill_tomato.tasks.making import make_world

GENERAL = "TomatoViewpoint-v1"


@pytest.mark.usefixtures("extras")
def test_the_list_names_everything_with_its_package_and_imports_none_of_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    main(["list"])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    for name in ("TomatoFromBelow-v1", "spiral", "coco", "potted", "folder", "iiwa7"):
        assert [name, "tomato-extras"] in lines
    for name in ("TomatoViewpointRow-v1", "nbv", "light", "one_tomato", "sunrise", "realsense", "iiwa14"):
        assert [name, "maniskill-tomato"] in lines
    assert not any(name.startswith("tomato_extras") for name in sys.modules)
    with pytest.raises(SystemExit):
        main(["list", "plans"])
    assert "did you mean 'plants'" in capsys.readouterr().err


@pytest.mark.usefixtures("extras")
@pytest.mark.parametrize("name", ["spiral", "tomato_extras.spiral:make_policy"])
def test_a_policy_of_another_package_searches_in_a_world(name: str) -> None:
    policy = open_policy(name, env_id=GENERAL)
    world = make_world(GENERAL, 2)
    world.reset([0, 1])
    policy.begin(world.belief, torch.arange(2))
    before = world.state.viewpoint.clone()
    moves = policy.act(world.belief)
    # The first circle: one look so far, 60 degrees up from the right, half a move long.
    np.testing.assert_allclose(moves[0], [0.5 * 0.5, 0.5 * np.sqrt(0.75), 0.0], atol=1e-6)
    world.step(moves)
    assert bool((world.state.viewpoint != before).any(dim=1).all())


@pytest.mark.usefixtures("extras")
def test_a_plant_of_another_generator_grows_in_every_task_and_is_the_same_for_a_seed() -> None:
    first, again = (PlantSpec.parse("potted", PlantSpec()).grow(7) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert (first.preset, first.seed, len(first.fruits)) == ("potted", 7, 5)
    # Of a ball about its middle: the icosphere's corners lie on it.
    fruit = first.organs[first.fruits[0].organ_index].parts[0].vertices
    away = np.linalg.norm(fruit - first.fruits[0].centre, axis=1)
    np.testing.assert_allclose(away, first.fruits[0].radius, atol=1e-5)
    row = PlantSpec.parse({"generator": "potted", "seed": "held_out", "row": True}, PlantSpec())
    assert len(row.grow(row.first_seed).fruits) == 15
    for env_id, plant in (
        ("TomatoViewpointGuided-v1", "potted"),
        (GENERAL, {"generator": "potted", "seed": "train"}),
    ):
        world = make_world(env_id, 1, plant=plant)
        world.reset(3)
        assert bool(torch.isfinite(world.observation()).all())


@pytest.mark.usefixtures("extras")
def test_a_segmenter_of_another_package_looks_at_images() -> None:
    image = np.full((120, 160, 3), 90, np.uint8)
    found = make_segmenter("coco", weights=None)(image)
    assert set(found.categories) <= {"tomato"} and found.masks.shape[1:] == (120, 160)
    with pytest.raises(InvalidInputError, match="unexpected keyword argument 'threshold'"):
        make_segmenter("coco", threshold=0.3)


class Strict:
    """A segmenter that knows no scores."""

    def __call__(self, image: object, depth_m: object = None) -> None: ...


def test_a_segmenter_without_scores_is_asked_for_none() -> None:
    assert isinstance(open_for_files(f"{__name__}:Strict", 0.3, thorough=False), Strict)


def test_a_name_with_a_typo_suggests_and_a_broken_one_says_what_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = ExtensionPoint("policy", "maniskill_tomato.nothing", {"nearby": "json:loads"})
    assert point.load("nearby")("[1]") == [1]
    with pytest.raises(InvalidInputError, match="did you mean 'nearby'"):
        point.load("nearbi")
    with pytest.raises(InvalidInputError, match="'nowhere_at_all:thing' cannot be loaded: No module"):
        point.load("nowhere_at_all:thing")
    with pytest.raises(
        InvalidInputError, match="'json:thing' cannot be loaded: .*can Python import json:thing"
    ):
        point.load("json:thing")
    # A module of the working directory is found.
    (tmp_path / "mine_alone.py").write_text("def make(context):\n    return 3\n")
    monkeypatch.chdir(tmp_path)
    assert find_policy("mine_alone:make", GENERAL) == "mine_alone:make"
    with pytest.raises(PolicyError, match="must make a policy, .*it made a int"):
        open_policy("mine_alone:make", env_id=GENERAL)
    for text in ("C:\\weights.pt", "a b:c", "photos:", ":train", "runs/x:y"):
        assert not is_import_path(text)


@pytest.mark.usefixtures("extras")
def test_two_packages_that_add_the_same_name_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    about = tmp_path / "tomato_rival-2.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: tomato-rival\nVersion: 2.0\n")
    rivals = "spiral = json:loads\nnbv = json:loads\n"
    (about / "entry_points.txt").write_text(f"[maniskill_tomato.policies]\n{rivals}")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(
        PolicyError,
        match=r"'spiral' is added by tomato-(extras|rival) and by tomato-(extras|rival); give package",
    ):
        open_policy("spiral", env_id=GENERAL)
    assert open_policy("tomato_extras.spiral:make_policy", env_id=GENERAL).name
    main(["list", "policies"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines if line.split()[0] == "nbv"] == [
        ["nbv", "maniskill-tomato,", "and", "also", "tomato-rival"]
    ]
    assert open_policy("nbv", env_id=GENERAL).name == "nbv"


def test_a_failure_of_another_package_is_not_called_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "failing_search.py").write_text(
        "import torch\ndef make(context): return torch.zeros(2) @ torch.zeros(3)\n"
    )
    (tmp_path / "unfinished_search.py").write_text("def make(context:\n")
    monkeypatch.chdir(tmp_path)
    judged = ["eval", GENERAL, "--episodes", "1", "--no-video", "--no-baseline", "--policy"]
    for name, status, words in (
        (
            "failing_search:make",
            1,
            "the policy 'failing_search:make' failed, which is not of maniskill-tomato",
        ),
        ("unfinished_search:make", 2, "'unfinished_search:make' cannot be loaded: "),
    ):
        with pytest.raises(SystemExit) as end:
            main([*judged, name])
        said = capsys.readouterr().err
        assert end.value.code == status and words in said.splitlines()[-1], said


def test_a_generator_that_makes_no_plant_is_refused() -> None:
    for name, words in (
        (f"{__name__}:no_plant", "must give a mapping from names to triangles"),
        (f"{__name__}:flat_plant", r"object 'leaf' must be an array of triangles of shape \(F, 3, 3\)"),
        (f"{__name__}:bare_plant", "has no fruit"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            PlantSpec(generator=name).grow(0)
    with pytest.raises(InvalidInputError, match="the plant generator must be one of .*pot"):
        PlantSpec(generator="pott")
    with pytest.raises(InvalidInputError, match="no field 'prest' beside generator"):
        PlantSpec.parse({"generator": f"{__name__}:no_plant", "prest": "full"}, PlantSpec())


def no_plant(seed: int) -> int:
    return seed


def flat_plant(seed: int) -> dict[str, np.ndarray]:
    return {"leaf": np.zeros((4, 3))}


def bare_plant(seed: int) -> dict[str, np.ndarray]:
    return {"leaf": np.random.default_rng(seed).normal(size=(4, 3, 3))}


class Pushing:
    """Answers as Stable-Baselines3's models do."""

    def predict(self, observation: np.ndarray, *, deterministic: bool = False) -> tuple[np.ndarray, None]:
        assert deterministic
        return np.tanh(3.0 * observation[..., :6]), None


def test_a_model_with_predict_acts_as_in_the_environment_that_it_learned_in() -> None:
    env_id = "TomatoViewpointGuided-v1"
    learned_in = make_gymnasium_env(env_id)
    world = make_world(env_id, 1)
    policy = sb3_policy(Pushing(), env_id)
    observation, _ = learned_in.reset(seed=4)
    world.reset(4)
    for _ in range(3):
        observation, *_ = learned_in.step(Pushing().predict(observation, deterministic=True)[0])
        world.step(policy.act(world.observation()))
        seen = normalize_observation(world.observation().numpy())
        np.testing.assert_allclose(seen[0], observation, atol=1e-5)


def test_stored_episodes_are_not_those_of_a_changed_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    module = tmp_path / "changing_policy.py"
    module.write_text("def make(context): ...\n")
    first = PolicySpec.parse("changing_policy:make").fingerprint
    assert PolicySpec.parse("changing_policy:make").fingerprint == first
    module.write_text("def make(context): return None\n")
    assert PolicySpec.parse("changing_policy:make").fingerprint != first
    assert PolicySpec.parse("nbv").fingerprint == "nbv"
