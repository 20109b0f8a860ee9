"""The tasks of this package as ManiSkill environments."""

from mani_skill.utils.registration import register

from maniskill_tomato.tasks import MAX_EPISODE_STEPS, MAX_GENERAL_STEPS, MAX_ROW_STEPS
from maniskill_tomato.tasks.maniskill.shell import RowEnv, SearchEnv, TomatoEnv


class TomatoViewpointGuidedEnv(TomatoEnv):
    """**Task Description:**
    One ripe tomato hangs behind leaves. Move the camera, step by step, to where it is fully visible; the
    reward (Eq. 5-3, 5-4) grows with the visible fraction V_f. A pose outside the workspace sends the arm
    home, and the episode goes on.

    **Randomizations:**
    - The end-effector starts uniformly in x [-0.1, 0.2], y [-0.35, 0.1], z [0.65, 1.15] m, roll 0, pitch
      [0.45 pi, 0.7 pi], yaw [0, 0.25 pi] (Eq. 5-1, 5-2), redrawn while the arm cannot reach the pose.

    **Success Conditions:**
    - V_f of the tomato is above 0.85.

    **Options** of both thesis tasks: `ThesisOptions`. `reset(options=...)` also takes `target` (index of a ripe fruit
    in `Plant.fruits`) and `viewpoint` (x, y, z, roll, pitch, yaw of the start), for all environments being reset.
    With `perception` target, V_f, reward and success are what a camera measures; the target is chosen when it is first
    seen.

    **Observation** (`state`, 9 numbers, world frame): end-effector x, y, z [m], roll, pitch, yaw [rad],
    target x, y, z [m].
    **Action** (`pd_viewpoint`, 6 numbers in [-1, 1]): increments of the first six, 1 meaning 1 m or 1 rad.
    **Info**, each of shape (num_envs,): `success`, `fail`, `visible_fraction`, `target_id` (segmentation id),
    `target_seen`, `tomato_seen`, `reachability` (`Reach`), `in_forbidden_zone`, `reward_visual`,
    `reward_penalty`. With `other_targets` K also what another target in the same place would have given, for the K
    ripe fruits that follow the target in the plant's order: `other_visible_fraction`, `other_success`,
    `other_reward`, `other_exists` (the plant has that many), each of shape (num_envs, K), and `other_position` in
    the world frame, in [m], of shape (num_envs, K, 3).
    """

    env_id = "TomatoViewpointGuided-v1"


class TomatoViewpointSparseEnv(TomatoEnv):
    """**Task Description:**
    Three ripe tomatoes hang behind leaves, and one of them is the target. Move the camera to where it is
    fully visible; only good views are rewarded (Eq. 5-9, 5-10). A pose outside the workspace ends the
    episode.

    **Randomizations:**
    - The target is one of the three ripe tomatoes.
    - The end-effector starts uniformly in x [-0.1, 0.2], y [-0.25, 0.25], z [0.65, 1.15] m, roll 0, pitch
      [0.45 pi, 0.7 pi], yaw [-pi/8, pi/8] (Eq. 5-7, 5-8), redrawn while the arm cannot reach the pose.

    **Success Conditions:**
    - V_f of the target is above 0.8.

    Options, observation, action and info are those of `TomatoViewpointGuidedEnv`.
    """

    env_id = "TomatoViewpointSparse-v1"


class TomatoViewpointGeneralEnv(SearchEnv):
    """**Task Description:**
    A ripe tomato of a plant between its neighbours in the row is hidden from the first view. Move the camera to where
    it is fully visible, in 20 moves or fewer.

    **Randomizations:**
    - A new plant at every reset out of a split of seeds, its leaf density, its neighbours and its pose.
    - The target is a ripe fruit of the middle plant.
    - The camera starts uniformly in a box before the plant and looks at the target, redrawn until the arm reaches the
      pose, touches nothing, and V_f is below 0.3.

    **Success Conditions:**
    - V_f of the target is above 0.8.

    **Options**, of `SearchOptions`:

    - `episodes`: `"validation"`, `"held_out"`, a `.json` file of such a list, or `Episode` objects, takes the episodes
      of a fixed list, `reset(seed=i)` its i-th (modulo its length).
    - `layout`: an `ObservationLayout`, or the parts' names, says what the observation holds.
    - `start_visibility`: range of V_f of the first view.
    - `contact_penalty`: what a move with plant contact costs.
    - `sensor_noise`: a `SensorNoise` or a mapping of its fields, what camera and segmenter get wrong.
    - `perception`: `"ground_truth"`, or a `Perception` with which V_f, success, reward, the target's position and the
      rays' labels come from a camera image with noisy depth; the info then also has `true_visible_fraction` and
      `true_success`. Those in `simulated_camera.RENDERED` need a renderer, and `segmenter` the extra `perception`.

    `reset(options=...)` takes `episode` (index in the list), `target` (index of a ripe fruit in `Plant.fruits`) and
    `camera_position` (x, y, z [m], world frame).

    **Observation** (`state`): the vector of `ViewpointObserver`; `state_dict` has its parts by name.
    **Action** (`pd_look_at`, 3 numbers in [-1, 1]): right, up, forward in the look frame, norm 1 meaning 0.12 m.
    **Info**, each of shape (num_envs,): `success`, `fail`, `visible_fraction`, `visible_fraction_gain`, `target_id`,
    `target_seen`, `tomato_seen`, `reachability` (`Reach`; neighbour: the move was shortened), `clearance` [m],
    `plant_contact`, `moves`, `path_length` [m].
    """

    env_id = "TomatoViewpoint-v1"


class TomatoViewpointRowEnv(RowEnv):
    """**Task Description:**
    Three plants of a row carry ripe tomatoes. Look at one after the other until each was fully visible: when a target
    has been seen, or 20 moves were made for it, the nearest one left is the next, and the memory begins anew.

    **Randomizations:**
    - As in `TomatoViewpoint-v1`; the first target is a ripe fruit in reach that is hidden from the first view.

    **Success Conditions:**
    - Every ripe fruit in reach was fully visible (V_f above 0.8) while it was the target.

    An arm that is bent the wrong way for the next target takes it up anew, by its ready posture (`robot.transit`): when
    the target changes and it cannot look at the new one from where the camera is, it goes to the nearest place
    `STAND_OFF` or more from it; when a move is refused though another posture reaches the place, it goes there. Such
    a transit counts as `TRANSIT_MOVES` moves with its whole path, clearance and cost.

    The episode fails when no target or no move of the 120 is left and some were not seen. Info has beside that of
    `TomatoViewpoint-v1`: `seen_count`, `target_count`, `target_done` (the target of this move was seen), `transits` (of
    this move) and `joint_path_length` [rad]. `visible_fraction` and `visible_fraction_gain` are those of the target
    that the move was made for, also when another one has just become the target. Episode lists do not apply.

    **Options:** `transits`: `"none"`, `"target"` (the first rule alone), `"refused"` (the second) or `"both"`.
    """

    env_id = "TomatoViewpointRow-v1"


# Gymnasium's registry has the ids already, lazily; these lines tell ManiSkill's own.
register("TomatoViewpointGuided-v1", TomatoViewpointGuidedEnv, max_episode_steps=MAX_EPISODE_STEPS)
register("TomatoViewpointSparse-v1", TomatoViewpointSparseEnv, max_episode_steps=MAX_EPISODE_STEPS)
register("TomatoViewpoint-v1", TomatoViewpointGeneralEnv, max_episode_steps=MAX_GENERAL_STEPS)
register("TomatoViewpointRow-v1", TomatoViewpointRowEnv, max_episode_steps=MAX_ROW_STEPS)
