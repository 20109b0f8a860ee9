"""A row that a robot inspects with its camera alone: what it senses, what it looks at next, and how that is judged."""

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.sensing.inspection import InspectedFruit, Inspection
from maniskill_tomato.sensing.inspection_judge import JudgedFruit, judge_fruits
from maniskill_tomato.sensing.view_lattice import ViewLattice
from maniskill_tomato.tasks.row.target_sequence import TargetSequence, Transits
from maniskill_tomato.tasks.senses import CameraSenses, ViewMeasurement, ViewPoses
from maniskill_tomato.tasks.world import World


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
            "a row that is inspected with a camera cannot be taken up from a saved state, which lacks the pictures "
            "that its map was made of; reset it with its seed"
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
        T_w_plant = world.plant_batch.T_world_plant[env_index]

        def fraction(fruit: int, view: int) -> float:
            T_w_links = link_transforms(self._view_qpos[env_index][view][None])
            poses = world.camera_poses(T_w_links)
            return float(world.scene.visible_fraction_from(poses, fruit, T_w_plant, T_w_links, env_index)[0])

        return judge_fruits(self.listed(env_index), plant, centres.double().cpu().numpy(), fraction)


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
