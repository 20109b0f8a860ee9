"""Rows searched by policies: which tomatoes were seen, which can be seen at all, and what it cost."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from maniskill_tomato.experiments.statistics import mean_interval, sign_flip_p
from maniskill_tomato.policies.oracle import FARTHEST, SHOULDER, shell_points
from maniskill_tomato.policies.protocol import Policy, reseed
from maniskill_tomato.robot.iiwa14 import READY_QPOS
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import MIN_DISTANCE, LookAtMover
from maniskill_tomato.sensing.view_lattice import ViewLattice

SAMPLES = 4096
"""Places round a tomato from which it is looked at, beside the lattice's candidates, before it counts as hidden."""

FARTHEST_VIEW = 0.75
"""Farthest of them from the tomato, in [m]; the lattice's last is 0.74 m."""

_BLOCK = 128


@dataclass(frozen=True, kw_only=True)
class RowResult:
    """One policy's search of one row."""

    seed: int
    targets: tuple[int, ...]
    """The tomatoes in reach, as indices in `Plant.fruits`."""
    seen: tuple[int, ...]
    """Those that were fully visible while they were the target."""
    finished: bool
    """Whether all were."""
    moves: int
    """Moves, each transit counted as `TRANSIT_MOVES`."""
    asked: int
    """Moves that the policy asked for."""
    refused: int
    """Those that the arm did not make."""
    contacts: int
    """Those on whose way, transits included, the arm touched a plant."""
    transits: int
    path_m: float
    """Way of the camera, transits included, in [m]."""
    joint_path_rad: float
    """Way of all joints together, in [rad]."""

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "RowResult":
        """The result whose fields were written as JSON."""
        lists = {name: tuple(content[name]) for name in ("targets", "seen")}
        return cls(**{**content, **lists})


def search_row(env: gym.Env[Any, Any], policy: Policy, seed: int) -> RowResult:
    """One episode of `TomatoViewpointRow-v1`, without exploration.

    Args:
        env: The task, with one environment.
        policy: Chooses the moves.
        seed: Of the reset.
    """
    world: Any = env.unwrapped
    reseed(policy, seed)
    env.reset(seed=seed)
    targets = tuple(world.open_targets(0))
    first = torch.zeros(1, dtype=torch.int64, device=world.device)
    policy.begin(world.belief, first)
    seen: list[int] = []
    asked = refused = contacts = transits = 0
    info: dict[str, Tensor] = {}
    done = False
    while not done:
        target = int(world.target_fruit[0])
        _, _, terminated, truncated, info = env.step(policy.act(world.belief))
        asked += 1
        refused += int(info["reachability"][0]) == int(Reach.UNREACHABLE)
        contacts += bool(info["plant_contact"][0])
        transits += int(info["transits"][0])
        if bool(info["target_done"][0]):
            seen.append(target)
        done = bool(terminated) or bool(truncated)
        if not done and int(world.target_fruit[0]) != target:
            policy.begin(world.belief, first)
    return RowResult(
        seed=seed,
        targets=targets,
        seen=tuple(sorted(seen)),
        finished=bool(info["success"][0]),
        moves=int(info["moves"][0]),
        asked=asked,
        refused=refused,
        contacts=contacts,
        transits=transits,
        path_m=float(info["path_length"][0]),
        joint_path_rad=float(info["joint_path_length"][0]),
    )


class SeeableTomatoes:
    """Asks the truth which tomatoes of a row the arm can see fully, from any place and in any posture.

    Samples may miss a narrow view, so that a tomato that is said to be hidden may yet be seen; one that is said to be
    seeable can be: the arm takes the place within its joint limits and is itself among what hides the tomato.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Follows an environment of `TomatoViewpointRow-v1`."""
        world: Any = env.unwrapped
        self._world: Any = world
        self._mover = LookAtMover(world.device)
        self._ready = torch.tensor(READY_QPOS, device=world.device)
        spread = shell_points(SAMPLES, MIN_DISTANCE, FARTHEST_VIEW).to(world.device)
        self._offsets = torch.cat([ViewLattice(world.device).offsets, spread])

    def among(self, fruits: Sequence[int], env_index: int = 0) -> list[int]:
        """Those of some fruits that can be seen."""
        return [
            fruit for fruit in fruits if self.best_view(fruit, env_index) > self._world.task.full_visibility
        ]

    def best_view(self, fruit: int, env_index: int = 0) -> float:
        """V_f of the first sampled view that is good enough, or of the best one."""
        target = self._world.fruit_position_w(env_index, fruit).double()
        places = target + self._offsets
        shoulder = places.new_tensor(SHOULDER)
        places = places[((places - shoulder).norm(dim=-1) <= FARTHEST) & (places[:, 2] > 0.0)]
        best = 0.0
        for first in range(0, len(places), _BLOCK):
            block = places[first : first + _BLOCK]
            padded = torch.cat([block, block[:1].expand(_BLOCK - len(block), 3)])
            look = self._mover.look_from(
                self._ready.expand(_BLOCK, 7), padded, target.expand(_BLOCK, 3), largest_joint_step=10.0
            )
            good = look.reach == int(Reach.REACHABLE)
            if not bool(good.any()):
                continue
            seen = self._world.ground_truth.visible_fraction(
                look.T_world_camera[good], env_index, look.qpos[good], fruit
            )
            best = max(best, float(seen.max()))
            if best > self._world.task.full_visibility:
                break
        return best


def rows_table(results: Mapping[str, Sequence[RowResult]], seeable: Mapping[int, set[int]]) -> str:
    """The policies' figures as Markdown.

    Args:
        results: Of each policy, on the same rows.
        seeable: The tomatoes that can be seen, by the row's seed.
    """
    first = next(iter(results.values()))
    wanted = sum(len(r.targets) for r in first)
    possible = sum(len(seeable[r.seed]) for r in first)
    lines = [
        f"{len(first)} rows, {wanted} tomatoes in reach, {possible} of them seeable.",
        "",
        "| policy | seen of the seeable | seen of all | moves per tomato seen | rows finished | moves | way of the "
        "camera [m] | joints [rad] | transits | refused moves | moves with contact |",
        "|---" * 11 + "|",
    ]
    for name, rows in results.items():
        count, asked = len(rows), sum(r.asked for r in rows)
        seen = sum(len(r.seen) for r in rows)
        low, high = mean_interval([_seen_share(r, seeable) for r in rows])
        lines.append(
            f"| {name} | {sum(len(seeable[r.seed] & set(r.seen)) for r in rows) / possible:.1%} "
            f"(rows: {low:.1%} to {high:.1%}) | {seen / wanted:.1%} "
            f"| {sum(r.moves for r in rows) / max(seen, 1):.2f} | {sum(r.finished for r in rows) / count:.0%} "
            f"| {sum(r.moves for r in rows) / count:.1f} | {sum(r.path_m for r in rows) / count:.1f} "
            f"| {sum(r.joint_path_rad for r in rows) / count:.0f} | {sum(r.transits for r in rows) / count:.1f} "
            f"| {sum(r.refused for r in rows) / asked:.0%} | {sum(r.contacts for r in rows) / asked:.0%} |"
        )
    return "\n".join(lines) + "\n"


def compare_rows(results: Mapping[str, Sequence[RowResult]], seeable: Mapping[int, set[int]]) -> list[str]:
    """One line for every two policies: paired differences over the rows, each row counting once."""
    names = list(results)
    lines = []
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            pairs = list(zip(results[a], results[b], strict=True))
            parts = []
            for what, values in (
                ("share seen", [_seen_share(x, seeable) - _seen_share(y, seeable) for x, y in pairs]),
                ("moves", [float(x.moves - y.moves) for x, y in pairs]),
            ):
                low, high = mean_interval(values)
                mean = sum(values) / len(values)
                parts.append(f"{what} {mean:+.3f} ({low:+.3f} to {high:+.3f}, p = {sign_flip_p(values):.3f})")
            lines.append(f"{a} less {b}: {', '.join(parts)}")
    return lines


def _seen_share(result: RowResult, seeable: Mapping[int, set[int]]) -> float:
    """Share of a row's seeable tomatoes that were seen; 1 where there is none."""
    possible = seeable[result.seed]
    return len(possible & set(result.seen)) / len(possible) if possible else 1.0
