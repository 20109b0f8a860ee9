"""Episodes stepped for a viewer: they are those of an evaluation, and snapshots tell what was known and decided."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.sensing.occlusion_memory import CELL_SIZE
from maniskill_tomato.tasks.vector_env import make_vector_env
from maniskill_tomato.view.episode_recording import EpisodeRecording, Voxel
from maniskill_tomato.view.page_fruits import fruit_list
from maniskill_tomato.view.page_head import headline
from maniskill_tomato.view.page_plot import curves
from maniskill_tomato.view.plant_meshes import organ_colours
from maniskill_tomato.view.play_session import PlaySession
from maniskill_tomato.view.play_settings import PlaySettings


def played(settings: PlaySettings) -> EpisodeRecording:
    session = PlaySession(settings)
    while session.step():
        pass
    assert session.is_over and not session.step()
    return session.recording


@pytest.mark.parametrize(
    ("env_id", "policy", "options"),
    [
        ("TomatoViewpoint-v1", "nbv", {"episodes": "held_out"}),
        ("TomatoViewpoint-v1", "random_viewpoint", {"episodes": "held_out"}),
        ("TomatoViewpointSparse-v1", "random", {}),
    ],
)
def test_an_episode_is_that_of_an_evaluation_with_the_same_seed(
    env_id: str, policy: str, options: dict[str, Any]
) -> None:
    recording = played(PlaySettings(env_id=env_id, policy=policy, seed=3))
    env: Any = make_vector_env(env_id, arrays="torch", autoreset_mode="Disabled", **options)
    record = run_episode(env, open_policy(policy, env_id=env_id, seed=3), 3)
    assert recording.moves == record.steps > 0
    np.testing.assert_allclose(recording.visible_fractions, record.visible_fraction, atol=1e-6)
    assert record.qpos is not None
    np.testing.assert_allclose([s.joint_positions for s in recording.snapshots], record.qpos, atol=1e-6)
    assert recording.outcome.startswith("fully visible") == record.success
    assert [s.was_refused for s in recording.snapshots[1:]] == record.refused.tolist()


@pytest.mark.parametrize(
    ("env_id", "policy"), [("TomatoViewpoint-v1", "random_step"), ("TomatoViewpointGuided-v1", "random")]
)
def test_an_episode_that_begins_again_is_the_same_even_if_its_policy_draws(env_id: str, policy: str) -> None:
    session = PlaySession(PlaySettings(env_id=env_id, policy=policy, seed=5))
    ways = []
    for _ in range(2):
        session.step()
        session.step()
        ways.append([snapshot.joint_positions for snapshot in session.recording.snapshots])
        session.begin(5)
    np.testing.assert_array_equal(ways[0], ways[1])


def test_a_snapshot_holds_the_views_that_the_policy_chooses_from_and_where_it_goes() -> None:
    recording = played(PlaySettings(policy="nbv"))
    for snapshot, after in zip(recording.snapshots, recording.snapshots[1:], strict=False):
        candidates = snapshot.candidates
        assert candidates is not None and snapshot.T_w_camera_next is not None
        assert np.isfinite(candidates.worth[candidates.chosen])
        camera, goal = snapshot.T_w_camera[:3, 3], candidates.positions[candidates.chosen]
        assert np.linalg.norm(goal - after.T_w_camera[:3, 3]) < np.linalg.norm(goal - camera)
        np.testing.assert_allclose(after.T_w_camera, snapshot.T_w_camera_next, atol=1e-4)
    last = recording.snapshots[-1]
    assert last.candidates is None and last.T_w_camera_next is None


def test_what_the_memory_believes_grows_with_every_view_and_agrees_with_its_predictions() -> None:
    session = PlaySession(PlaySettings(policy="nbv"))
    assert session.step()
    unknown = []
    for snapshot in session.recording.snapshots:
        foliage = snapshot.foliage
        assert foliage is not None and foliage.cell_size == CELL_SIZE
        unknown.append(len(foliage.places(Voxel.UNKNOWN)))
        assert sum(len(foliage.places(kind)) for kind in Voxel) == 32**3
        np.testing.assert_allclose(foliage.centre, snapshot.target_position, atol=1e-6)
    assert unknown[1] < unknown[0] < 32**3


def test_blocked_voxels_are_where_leaves_are() -> None:
    recording = played(PlaySettings(policy="nbv"))
    foliage = recording.snapshots[-1].foliage
    assert foliage is not None
    assert recording.plant is not None
    vertices = recording.plant.vertices @ recording.T_w_plant[:3, :3].T + recording.T_w_plant[:3, 3]
    corners = torch.as_tensor(vertices[recording.plant.faces].mean(1), dtype=torch.float32)

    def distance(kind: Voxel) -> float:
        places = torch.as_tensor(foliage.places(kind)[:500])
        return float(torch.cdist(places, corners).amin(dim=1).median())

    assert distance(Voxel.BLOCKED) < 0.02 < distance(Voxel.FREE)


def test_a_camera_tells_its_map_of_fruits_and_the_truth_stands_beside_what_it_measured() -> None:
    session = PlaySession(PlaySettings(perception="occlusion_model", policy="nbv", target="any"))
    session.step()
    snapshot = session.recording.snapshots[-1]
    assert session.recording.plant is not None
    centres = np.array([fruit.centre for fruit in session.recording.plant.fruits])
    centres = centres @ session.recording.T_w_plant[:3, :3].T + session.recording.T_w_plant[:3, 3]
    assert snapshot.true_visible_fraction is not None and len(snapshot.fruits) > 3
    assert sum(fruit.is_target for fruit in snapshot.fruits) <= 1
    errors = [np.linalg.norm(centres - fruit.position, axis=1).min() for fruit in snapshot.fruits]
    assert np.median(errors) < 0.01


def test_a_camera_tells_how_far_off_its_fraction_may_be_and_goes_by_the_lower_edge() -> None:
    session = PlaySession(PlaySettings(perception="occlusion_model", policy="nbv", target="any"))
    session.step()
    for snapshot in session.recording.snapshots:
        assert snapshot.measured is not None
        low, value, high = snapshot.measured.band
        assert 0.0 <= low <= value <= high <= 1.0
        assert low == pytest.approx(snapshot.visible_fraction, abs=1e-6)
    last = session.recording.snapshots[-1].measured
    assert last is not None and last.margin > 0.0
    lines = {str(series.get("label")): values for series, values in curves(session.recording)}
    bands = [s.measured.band for s in session.recording.snapshots if s.measured is not None]
    for name, edge in (("at least", 0), ("V_f", 1), ("at most", 2)):
        np.testing.assert_allclose(lines[name], [band[edge] for band in bands])
    assert f"from {bands[1][0]:.2f} to {bands[1][2]:.2f}" in headline(session.recording, 1)


def test_the_list_of_fruits_tells_how_far_off_the_fraction_of_each_may_be() -> None:
    session = PlaySession(PlaySettings(perception="occlusion_model", policy="nbv", target="any"))
    session.step()
    snapshot = session.recording.snapshots[-1]
    target = next(fruit for fruit in snapshot.fruits if fruit.is_target)
    assert target.fraction is not None and snapshot.measured is not None
    np.testing.assert_allclose(target.fraction.band, snapshot.measured.band, atol=1e-6)
    seen = [fruit for fruit in snapshot.fruits if fruit.fraction is not None]
    assert 1 < len(seen) and all(f.fraction.margin > 0.0 for f in seen if f.fraction is not None)
    rows = re.findall(r"<tr.*?</tr>", fruit_list(snapshot, has_map=True))[1:]
    texts = [re.sub(r"<[^>]+>", "|", row) for row in rows]
    assert len(texts) == len(snapshot.fruits) and f"{target.number}, " in texts[0] and ", target" in texts[0]
    for fruit in snapshot.fruits:
        (text,) = (t for t in texts if t.strip("|").startswith(f"{fruit.number}, "))
        if fruit.fraction is None:
            assert "|-||-|" in text
        else:
            low, value, high = fruit.fraction.band
            assert f"|{value:.2f}||{low:.2f} to {high:.2f}|" in text
        assert text.rstrip("|").endswith(f"{1000.0 * fruit.spread:.0f} mm")
        assert ("unripe" not in text) == fruit.is_ripe
    session = PlaySession(PlaySettings(policy="nbv"))
    assert "The exact senses need no map" in fruit_list(session.recording.snapshots[0], has_map=False)


def test_a_refused_move_is_told_with_its_reason() -> None:
    recording = played(PlaySettings(policy="random_step", seed=1))
    refused = [s for s in recording.snapshots if s.was_refused]
    assert refused and all(s.event.startswith("refused: the arm does not reach") for s in refused)
    assert not recording.snapshots[0].event


def test_a_row_counts_the_tomatoes_that_were_seen() -> None:
    session = PlaySession(PlaySettings(env_id="TomatoViewpointRow-v1", policy="nbv"))
    while not any("saw its target" in s.event for s in session.recording.snapshots):
        assert session.step()
    targets = {snapshot.target_organ for snapshot in session.recording.snapshots}
    assert len(targets) == 2


def test_the_wrist_picture_shows_a_red_target_where_it_is_expected() -> None:
    recording = played(PlaySettings(policy="nbv"))
    picture = recording.picture(recording.moves).astype(int)
    height, width = picture.shape[:2]
    # The camera looks at its target.
    red, green, _ = picture[height // 2 - 5 : height // 2 + 5, width // 2 - 5 : width // 2 + 5].mean((0, 1))
    assert red > 1.5 * green
    corner = picture[:10, :10].mean((0, 1))
    assert corner[0] < 1.5 * corner[1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"env_id": "TomatoViewpoint-v2"}, "env_id must be one of"),
        ({"perception": "segmenter"}, "perception must be one of"),
        ({"target": "nearest"}, "target must be one of"),
        ({"seed": -1}, "seed must be from 0"),
    ],
)
def test_settings_that_cannot_be_played_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        PlaySettings(**options)  # type: ignore[arg-type]


def test_a_camera_taken_by_hand_sees_what_the_arm_would_see_from_there() -> None:
    recording = played(PlaySettings(policy="nbv"))
    session = PlaySession(PlaySettings(policy="nbv"))
    last = recording.snapshots[-1]
    view = session.look_from(last.T_w_camera[:3, 3])
    assert view.is_reachable and view.visible_fraction == pytest.approx(last.visible_fraction, abs=0.03)
    ahead = view.T_w_camera[:3, 2]
    way = last.target_position - view.T_w_camera[:3, 3]
    np.testing.assert_allclose(ahead, way / np.linalg.norm(way), atol=1e-6)
    first = session.look_from(session.recording.snapshots[0].T_w_camera[:3, 3])
    assert first.visible_fraction == pytest.approx(recording.snapshots[0].visible_fraction, abs=0.03)
    assert not session.look_from(last.target_position + [-3.0, 0.0, 0.0]).is_reachable


@pytest.mark.parametrize(
    ("env_id", "policy"), [("TomatoViewpoint-v1", "nbv"), ("TomatoViewpointGuided-v1", "random")]
)
def test_a_target_that_is_hung_before_the_leaves_is_seen_from_where_the_camera_is(
    env_id: str, policy: str
) -> None:
    session = PlaySession(PlaySettings(env_id=env_id, policy=policy))
    if policy == "nbv":
        session.step()
    before = session.recording.snapshots[-1]
    views = len(session.recording.snapshots)
    own, place = session.recording.plant, session.target_place()
    assert place is not None
    assert before.rays is not None and not before.rays.is_seen.all() and before.visible_fraction < 0.8
    nearer = place + 0.5 * (before.T_w_camera[:3, 3] - place)
    session.move_target(nearer)
    after = session.recording.snapshots[-1]
    hung = session.target_place()
    assert hung is not None
    np.testing.assert_allclose(hung, nearer, atol=1e-5)
    np.testing.assert_allclose(after.target_position, nearer, atol=1e-5)
    assert after.rays is not None and after.rays.is_seen.all() and after.visible_fraction > 0.95
    assert after.event == before.event and len(session.recording.snapshots) == views
    np.testing.assert_array_equal(after.joint_positions, before.joint_positions)
    session.begin(session.settings.seed)
    assert session.recording.plant is own
    again = PlaySession(PlaySettings(env_id=env_id, policy=policy)).recording.snapshots[0]
    first = session.recording.snapshots[0]
    assert first.visible_fraction == again.visible_fraction
    np.testing.assert_array_equal(first.picture, again.picture)


def test_the_policy_goes_for_where_the_target_was_left() -> None:
    session = PlaySession(PlaySettings(policy="nbv"))
    hung = session.target_place()
    assert hung is not None
    place = hung + [0.0, 0.1, 0.05]
    session.move_target(place)
    session.decide_again()
    decided = session.recording.snapshots[-1]
    assert decided.foliage is not None and decided.T_w_camera_next is not None
    np.testing.assert_allclose(decided.foliage.centre, place, atol=1e-5)
    ahead, way = decided.T_w_camera_next[:3, 2], place - decided.T_w_camera_next[:3, 3]
    np.testing.assert_allclose(ahead, way / np.linalg.norm(way), atol=1e-3)
    assert session.step()
    np.testing.assert_allclose(session.recording.snapshots[-1].target_position, place, atol=1e-5)


def test_a_target_that_a_camera_chooses_cannot_be_dragged() -> None:
    session = PlaySession(PlaySettings(perception="occlusion_model", policy="nbv", target="any"))
    assert session.target_place() is None
    with pytest.raises(InvalidInputError, match="take the senses ground_truth"):
        session.move_target(np.zeros(3))


def test_rays_to_the_target_end_on_it_or_on_what_hides_it() -> None:
    recording = played(PlaySettings(policy="nbv"))
    assert recording.plant is not None
    for snapshot in (recording.snapshots[0], recording.snapshots[-1]):
        rays = snapshot.rays
        assert rays is not None and len(rays.ends) > 8
        away = np.linalg.norm(rays.ends - snapshot.target_position, axis=1)
        assert np.all(away[rays.is_seen] < 0.05)
        camera = np.linalg.norm(snapshot.T_w_camera[:3, 3] - snapshot.target_position)
        to_end = np.linalg.norm(rays.ends - snapshot.T_w_camera[:3, 3], axis=1)
        assert np.all(to_end[~rays.is_seen] < camera)
        assert rays.is_seen.mean() == pytest.approx(snapshot.visible_fraction, abs=0.25)


def test_plants_from_a_mesh_file_are_played_in_their_own_colours(tmp_path: Path) -> None:
    shape: Any = trimesh.creation.icosphere(2, 0.03)
    shape.visual.face_colors = [200, 30, 20, 255]
    shape.apply_translation([0.0, 0.0, 0.8])
    leaf: Any = trimesh.creation.box((0.002, 0.06, 0.06))
    leaf.visual.face_colors = [20, 120, 30, 255]
    leaf.apply_translation([-0.06, 0.02, 0.8])
    scene: Any = trimesh.Scene({"fruit_0": shape, "leaf_0": leaf})
    path = tmp_path / "plant.glb"
    path.write_bytes(scene.export(file_type="glb"))
    options = {"plant": {"mesh": str(path)}, "start_visibility": (0.0, 1.0)}
    session = PlaySession(PlaySettings(policy="nbv", plant_options=options))
    plant = session.recording.plant
    assert plant is not None and len(plant.fruits) == 1
    colours = dict(zip([o.semantic_class.name for o in plant.organs], organ_colours(plant), strict=True))
    # The file's numbers are linear light.
    np.testing.assert_allclose(colours["LEAF"], [79, 182, 96], atol=3)
