"""A row that a robot inspects with its camera alone: what it senses, what it looks at next, and how that is judged."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.sensing.inspection import InspectedFruit, Inspection
from maniskill_tomato.sensing.view_lattice import ViewLattice
from maniskill_tomato.tasks.row.senses import NO_FRUIT, CameraSenses, ViewMeasurement, ViewPoses
from maniskill_tomato.tasks.row.target_sequence import TargetSequence, Transits
from maniskill_tomato.tasks.world import World

NEAREST_FRUIT = 0.03
"""A listed fruit that no view tells is the nearest one of the plant, if that is nearer than this, in [m]."""


@dataclass(frozen=True, kw_only=True)
class JudgedFruit:
    """One fruit of an inspection list beside the truth."""

    fruit: int
    """Which fruit of the plant it is, as an index in `Plant.fruits`; -1 if none."""
    is_ripe: bool
    """What the list says."""
    is_truly_ripe: bool
    is_fully_seen: bool
    """What the list says."""
    true_fraction: float
    """V_f of the fruit in the view that showed most of it; 0 if there was none."""
    position_error_m: float
    """Distance of the listed centre from the true one, in [m]; -1 for no fruit."""
    radius_error_m: float
    """Listed radius less the true one, in [m]; 0 for no fruit."""


class InspectingSenses(CameraSenses):
    """Camera senses that keep one map for a whole row and choose the targets from it."""

    def setup(self, lattice: ViewLattice) -> None:
        """Begins with the lattice that says what is in reach."""
        self._lattice = lattice
        n = self._world.num_envs
        self.inspections = [self._new_inspection() for _ in range(n)]
        """Of each environment."""
        self._to_recall: set[int] = set()
        self._view_qpos: list[list[Tensor]] = [[] for _ in range(n)]

    def _new_inspection(self) -> Inspection:
        return Inspection(self._full_visibility, self._perception.config.stop_errors)

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float) -> None:
        """Draws the seed that the errors of an episode follow from, and begins an empty map."""
        super().begin(env_index, rng, 0.0)
        self.inspections[env_index] = self._new_inspection()
        self._view_qpos[env_index] = []
        self._perception.begin(env_index, threshold=self._full_visibility)

    def begin_targets(self, env_idx: Tensor) -> None:
        """Nothing: the map stays, and `turn` has chosen."""

    def recall_targets(self, env_idx: Tensor) -> None:
        """Refused: an inspection follows from all of its views.

        Raises:
            InvalidInputError: Always.
        """
        raise InvalidInputError(
            "a row that is inspected with a camera cannot be taken up from a saved state; reset it with its seed"
        )

    def look(self, view: ViewPoses) -> tuple[ViewMeasurement, Tensor | None]:
        """Takes and measures frames where the camera has moved or an episode begins."""
        world = self._world
        mask = torch.ones(world.num_envs, dtype=torch.bool, device=world.device)
        mask = mask if view.mask is None else view.mask.clone()
        looking = mask.tolist()
        for i, known in enumerate(self._view_qpos):
            still = bool(known) and torch.equal(known[-1], view.qpos[i])
            if looking[i] and (still or self.inspections[i].is_over):
                mask[i] = False
        moved = self._take(view, mask)
        for i in mask.nonzero()[:, 0].tolist():
            self._view_qpos[i].append(view.qpos[i].clone())
            last, inspection = self._perception.last_view(i), self.inspections[i]
            assert last is not None
            inspection.take_in(self._perception.map(i), last)
            if inspection.aim is None and not inspection.is_over:
                moved[i] |= self.turn(i)
                self._to_recall.discard(i)
        for i in range(world.num_envs):
            if looking[i] and i in self._to_recall:
                self._to_recall.discard(i)
                moved[i] = True
            if mask[i]:
                self._judge_by(i, self._shown_fruit(i))
        measured = self._measured(view, self._chosen(mask))
        return measured, moved.nonzero()[:, 0]

    def turn(self, env_index: int) -> bool:
        """Turns to what is worth looking at next; False if nothing is."""
        position = self._world.T_w_camera[env_index, :3, 3].double().cpu().numpy()
        fruits = self._perception.map(env_index)
        aim = self.inspections[env_index].next(fruits, position, self._lattice)
        if aim is None:
            return False
        self._perception.turn_to(env_index, aim.track, aim.position_w)
        self._to_recall.add(env_index)
        return True

    def is_done(self, env_index: int, moves: int, max_moves: int) -> bool:
        """Whether an environment is done with what it looks at."""
        inspection = self.inspections[env_index]
        return not inspection.is_over and inspection.is_done(
            self._perception.map(env_index), moves, max_moves
        )

    def fully_seen(self, env_index: int) -> tuple[bool, int]:
        """Whether the target is fully seen, and how many ripe fruits are."""
        inspection, fruits = self.inspections[env_index], self._perception.map(env_index)
        target = None if inspection.aim is None else inspection.aim.track
        full = [n for n, track in fruits.tracks.items() if track.is_ripe and inspection.is_full(n)]
        return target in full, len(full)

    def listed(self, env_index: int) -> list[InspectedFruit]:
        """The inspection list so far."""
        return self.inspections[env_index].fruits(self._perception.map(env_index))

    def judged(self, env_index: int) -> list[JudgedFruit]:
        """The inspection list so far beside the truth."""
        world, plant = self._world, self._world.plant_batch.plants[env_index]
        centres = world.plant_batch.fruit_positions_w(env_index, list(range(len(plant.fruits))))
        true_centres = centres.double().cpu().numpy()
        return [self._judged_fruit(env_index, fruit, true_centres) for fruit in self.listed(env_index)]

    def _judged_fruit(
        self, env_index: int, fruit: InspectedFruit, centres: NDArray[np.float64]
    ) -> JudgedFruit:
        world, plant, best = self._world, self._world.plant_batch.plants[env_index], fruit.best
        number = NO_FRUIT if best is None or best.shown_fruit is None else best.shown_fruit
        away = np.linalg.norm(centres - fruit.position_w, axis=1)
        if number == NO_FRUIT and away.min() < NEAREST_FRUIT:
            number = int(away.argmin())
        if number == NO_FRUIT:
            return JudgedFruit(
                fruit=number,
                is_ripe=fruit.is_ripe,
                is_truly_ripe=False,
                is_fully_seen=fruit.is_fully_seen,
                true_fraction=0.0,
                position_error_m=-1.0,
                radius_error_m=0.0,
            )
        fraction = 0.0
        if best is not None:
            pose = torch.as_tensor(best.T_world_camera, dtype=torch.float32, device=world.device)[None]
            links = link_transforms(self._view_qpos[env_index][best.view][None])
            T_w_plant = world.plant_batch.T_world_plant[env_index]
            fraction = float(world.scene.visible_fraction_from(pose, number, T_w_plant, links, env_index)[0])
        return JudgedFruit(
            fruit=number,
            is_ripe=fruit.is_ripe,
            is_truly_ripe=plant.fruits[number].ripeness == "ripe",
            is_fully_seen=fruit.is_fully_seen,
            true_fraction=round(fraction, 5),
            position_error_m=round(float(away[number]), 5),
            radius_error_m=round(fruit.radius_m - plant.fruits[number].radius, 5),
        )


class InspectedSequence(TargetSequence):
    """The targets that a robot with a camera chooses; it is told none."""

    def __init__(
        self, world: World, lattice: ViewLattice, transits: Transits, senses: InspectingSenses
    ) -> None:
        """Follows a world.

        Args:
            world: The plants and arms.
            lattice: Says what the arm reaches.
            transits: When an arm goes by its ready posture.
            senses: Know the maps.
        """
        super().__init__(world, lattice, transits)
        self.senses = senses
        senses.setup(lattice)

    def is_over(self) -> Tensor:
        """Whether nothing is worth another move. Shape (N,), bool."""
        over = [inspection.is_over for inspection in self.senses.inspections]
        return torch.tensor(over, device=self._world.device)

    def is_success(self) -> Tensor:
        """The same: what was truly seen says `judged`. Shape (N,), bool."""
        return self.is_over()

    def finish(self, full_visibility: float, max_moves: int) -> list[int]:
        """Counts what the last move saw; returns the environments that turn to something else."""
        state = self._world.state
        told = [self.senses.fully_seen(i) for i in range(self._world.num_envs)]
        state.target_done = torch.tensor([done for done, _ in told], device=self._world.device)
        state.seen_count = torch.tensor([count for _, count in told], device=self._world.device)
        moves, turned = state.target_moves.tolist(), []
        for i in range(self._world.num_envs):
            if self.senses.is_done(i, moves[i], max_moves) and self.senses.turn(i):
                state.target_moves[i] = 0
                turned.append(i)
        return turned
