"""A person solves episodes on the page: which are kept, and that others can make and replay them."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.imitation.demonstrations import record_demonstrations
from maniskill_tomato.learning.imitation.trajectory_file import read_demonstrations
from maniskill_tomato.learning.rl.envs import make_simulated_env
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.tasks.vector_env import make_vector_env
from maniskill_tomato.view.demonstrating import PersonsDemonstrations
from maniskill_tomato.view.play_session import PlaySession
from maniskill_tomato.view.play_settings import PlaySettings
from maniskill_tomato.view.player import Player

SPARSE, GUIDED, GENERAL = "TomatoViewpointSparse-v1", "TomatoViewpointGuided-v1", "TomatoViewpoint-v1"
ARRIVED = 0.01
"""In [m]."""


def shown(env_id: str, seed: int = 0) -> PlaySettings:
    policy = "stay" if env_id == GENERAL else "random"
    return PlaySettings(env_id=env_id, policy=policy, seed=seed, is_demonstrated=True)


def good_view(session: PlaySession, least: float = 0.95) -> NDArray[np.float64]:
    """A place from which the target is seen, found by looking from some with the camera in the hand."""
    target = session.target_place()
    assert target is not None
    rng = np.random.default_rng(1)
    for _ in range(500):
        away = rng.normal(size=3)
        place = target + rng.uniform(0.25, 0.45) * away / np.linalg.norm(away)
        view = session.look_from(place)
        if view.is_reachable and view.visible_fraction >= least:
            return place
    raise AssertionError("no place was found")


def solve(session: PlaySession) -> None:
    """The person's episode."""
    place = good_view(session)
    while not session.is_over:
        session.move_camera(place)
    assert session.recording.outcome.startswith("fully visible")


def stored(path: Path) -> list[dict[str, Any]]:
    """The arrays of every described episode, with its description under `entry`."""
    entries = json.loads(path.with_suffix(".json").read_text())["episodes"]
    with h5py.File(path) as file:
        assert sorted(file) == sorted(f"traj_{entry['episode_id']}" for entry in entries)
        groups: Any = [file[f"traj_{entry['episode_id']}"] for entry in entries]
        return [
            {"entry": entry, **{name: group[name][()] for name in group}}
            for entry, group in zip(entries, groups, strict=True)
        ]


@pytest.mark.parametrize(("env_id", "seed"), [(SPARSE, 3), (GENERAL, 2)])
def test_what_a_person_did_replays_as_it_was_seen(env_id: str, seed: int, tmp_path: Path) -> None:
    settings = shown(env_id, seed)
    session = PlaySession(settings, PersonsDemonstrations(tmp_path, settings))
    solve(session)
    path = tmp_path / "trajectory.h5"
    (episode,) = stored(path)
    assert episode["entry"]["success"] and episode["entry"]["reset_kwargs"] == {"options": None, "seed": seed}
    assert len(episode["actions"]) == session.recording.moves == episode["entry"]["elapsed_steps"]
    assert episode["terminated"].tolist() == [False] * (len(episode["actions"]) - 1) + [True]
    cast: Any = make_vector_env(env_id, arrays="torch", autoreset_mode="Disabled", **settings.world_options())
    described = json.loads(path.with_suffix(".json").read_text())["env_info"]
    assert described["env_id"] == f"maniskill_tomato:{env_id}"
    simulated: Any = make_simulated_env(env_id, **described["env_kwargs"])
    for env, tolerance in ((cast, 0.0), (simulated, 1e-4)):
        info: dict[str, Any] = {}
        seen, _ = env.reset(seed=seed)
        np.testing.assert_allclose(seen[0].numpy(), episode["obs"][0], atol=tolerance)
        for step, action in enumerate(episode["actions"]):
            seen, reward, terminated, _, info = env.step(torch.from_numpy(action)[None])
            np.testing.assert_allclose(seen[0].numpy(), episode["obs"][step + 1], atol=tolerance)
            np.testing.assert_allclose(reward.numpy(), episode["rewards"][step], atol=1e-4)
            assert bool(terminated[0]) == episode["terminated"][step]
        assert bool(info["success"][0])
    simulated.close()


def test_a_learner_reads_what_a_person_showed(tmp_path: Path) -> None:
    settings = shown(GUIDED)
    session = PlaySession(settings, PersonsDemonstrations(tmp_path, settings))
    solve(session)
    session.begin(1)
    solve(session)
    read = read_demonstrations(tmp_path / "trajectory.h5", GUIDED)
    episodes = stored(tmp_path / "trajectory.h5")
    np.testing.assert_array_equal(read.actions.numpy(), np.concatenate([e["actions"] for e in episodes]))
    assert read.episodes == 2 and [e["entry"]["episode_seed"] for e in episodes] == [0, 1]
    np.testing.assert_array_equal(read.views.numpy(), np.concatenate([e["obs"][1:] for e in episodes]))
    np.testing.assert_array_equal(
        read.terminations.numpy(), np.concatenate([e["terminated"] for e in episodes])
    )


def test_a_person_who_demonstrates_is_not_led_by_the_policy(tmp_path: Path) -> None:
    settings = PlaySettings(policy="nbv", is_demonstrated=True)
    hint = PlaySession(settings).recording.snapshots[0]
    alone = PlaySession(settings, PersonsDemonstrations(tmp_path, settings)).recording.snapshots[0]
    assert hint.candidates is not None and hint.T_w_camera_next is not None
    assert alone.candidates is None and alone.T_w_camera_next is None


def test_only_what_a_person_solved_alone_is_kept(tmp_path: Path) -> None:
    settings = shown(GUIDED)
    session = PlaySession(settings, PersonsDemonstrations(tmp_path, settings))
    place = good_view(session)
    session.step()
    assert not session.is_over
    while not session.is_over:
        session.move_camera(place)
    assert session.demonstrated is not None and "not** count: a policy moved" in session.demonstrated
    session.begin(0)
    target = session.target_place()
    assert target is not None
    session.move_target(target + [0.0, 0.0, 0.01])
    while not session.is_over:
        session.move_camera(place)
    assert "not** count: the target was hung elsewhere" in session.demonstrated
    session.begin(0)
    here = session.recording.snapshots[0].T_w_camera[:3, 3]
    while not session.is_over:
        session.move_camera(here)
    assert session.recording.outcome.startswith("not fully visible")
    assert "not** count: it ended without success" in session.demonstrated
    session.begin(0)
    session.move_camera(here)
    session.begin(0)
    assert "**0** demonstrations" in session.demonstrated and not list(tmp_path.iterdir())
    solve(session)
    assert "**1** demonstrations" in session.demonstrated and "this one is kept" in session.demonstrated
    (episode,) = stored(tmp_path / "trajectory.h5")
    assert len(episode["actions"]) == session.recording.moves


def test_a_place_to_which_no_move_leads_is_refused_and_the_episode_goes_on(tmp_path: Path) -> None:
    settings = shown(SPARSE, 3)
    session = PlaySession(settings, PersonsDemonstrations(tmp_path, settings))
    with pytest.raises(InvalidInputError, match="the arm takes no pose on the way"):
        session.move_camera(np.array([0.0, 0.0, 9.0]))
    assert session.recording.moves == 0
    solve(session)
    assert len(stored(tmp_path / "trajectory.h5")) == 1
    with pytest.raises(InvalidInputError, match="the episode is over"):
        session.move_camera(np.zeros(3))


@pytest.mark.parametrize("env_id", [GUIDED, GENERAL])
def test_the_arm_comes_to_where_the_camera_is_held(env_id: str) -> None:
    session = PlaySession(shown(env_id))
    place = good_view(session, 0.0)
    ways = [np.linalg.norm(session.recording.snapshots[0].T_w_camera[:3, 3] - place)]
    while not session.is_over and ways[-1] > ARRIVED:
        session.move_camera(place)
        ways.append(np.linalg.norm(session.recording.snapshots[-1].T_w_camera[:3, 3] - place))
        assert ways[-1] < ways[-2]
        assert len(ways) < 8
    last = session.recording.snapshots[-1]
    ahead = last.target_position - last.T_w_camera[:3, 3]
    np.testing.assert_allclose(last.T_w_camera[:3, 2], ahead / np.linalg.norm(ahead), atol=2e-3)
    assert session.is_over or ways[-1] < ARRIVED


def test_a_folder_goes_on_with_the_same_task_and_refuses_anything_else(tmp_path: Path) -> None:
    folder = tmp_path / "shown"
    settings = shown(GUIDED)
    solve(PlaySession(settings, PersonsDemonstrations(folder, settings)))
    (first,) = stored(folder / "trajectory.h5")
    other_plant = PlaySettings(
        env_id=GUIDED, is_demonstrated=True, plant_options={"plant": {"seed": 3}}, policy="random"
    )
    for other in (shown(SPARSE), other_plant):
        with pytest.raises(InvalidInputError, match="choose another folder"):
            PersonsDemonstrations(folder, other)
    again = PersonsDemonstrations(folder, settings)
    player = Player(partial(PlaySession, demonstrations=again), settings)
    with pytest.raises(InvalidInputError, match="choose another folder"):
        player.change(env_id=SPARSE)
    assert player.settings == settings
    player.change(seed=2)
    place = good_view(PlaySession(shown(GUIDED, 2)))
    while not player.is_at_end:
        player.move_camera(place)
    kept, added = stored(folder / "trajectory.h5")
    assert (kept["entry"], added["entry"]["episode_seed"]) == (first["entry"], 2)
    for name in ("obs", "actions", "rewards"):
        np.testing.assert_array_equal(kept[name], first[name])
    env: Any = make_simulated_env(GUIDED)
    record_demonstrations(env, open_policy("random", env_id=GUIDED), range(1), tmp_path / "policy")
    with pytest.raises(InvalidInputError, match="moves that a policy made"):
        PersonsDemonstrations(tmp_path / "policy", settings)


def test_an_episode_that_a_crash_left_without_its_description_is_dropped(tmp_path: Path) -> None:
    settings = shown(GUIDED)
    session = PlaySession(settings, PersonsDemonstrations(tmp_path, settings))
    solve(session)
    description = (tmp_path / "trajectory.json").read_bytes()
    session.begin(1)
    solve(session)
    (tmp_path / "trajectory.json").write_bytes(description)
    session = PlaySession(settings, PersonsDemonstrations(tmp_path, settings))
    session.begin(2)
    solve(session)
    assert [e["entry"]["episode_seed"] for e in stored(tmp_path / "trajectory.h5")] == [0, 2]


def test_a_damaged_folder_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    settings = shown(GUIDED)
    solve(PlaySession(settings, PersonsDemonstrations(tmp_path, settings)))
    path = tmp_path / "trajectory.h5"
    cut = path.read_bytes()[:1000]
    path.write_bytes(cut)
    with pytest.raises(InvalidInputError, match="cannot be read as demonstrations"):
        PersonsDemonstrations(tmp_path, settings)
    assert path.read_bytes() == cut
    path.unlink()
    with pytest.raises(InvalidInputError, match="there is no file"):
        PersonsDemonstrations(tmp_path, settings)


def test_demonstrations_are_not_of_the_held_out_plants() -> None:
    assert "episodes" not in shown(GENERAL).world_options()
    assert PlaySettings().world_options() == {"episodes": "held_out"}
    named = PlaySettings(episode_list="validation", is_demonstrated=True)
    assert named.world_options() == {"episodes": "validation"}
