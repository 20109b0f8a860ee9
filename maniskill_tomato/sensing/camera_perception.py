"""From the frames of N cameras to what is known of their targets: V_f, position, rays about it.

Simulated worlds and the robot use the same class; what differs is who takes the frames.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.view_rays import RAYS_PER_SIDE, RayLabel, ViewRays
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.measurement import Measurement, Position
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.target_tracker import TargetTracker

_NO_RAYS = ViewRays(
    torch.tensor([0.0, 0.0, 1.0]).expand(1, RAYS_PER_SIDE**2, 3),
    torch.zeros(1, RAYS_PER_SIDE**2),
    torch.full((1, RAYS_PER_SIDE**2), int(RayLabel.OUTSIDE), dtype=torch.int8),
)


class CameraPerception:
    """Measures the frames of N environments and follows one target in each."""

    def __init__(
        self,
        num_envs: int,
        detector: FruitDetector,
        *,
        identity_known: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        """Begins with all targets at the origin.

        Args:
            num_envs: Number of environments N.
            detector: Finds and measures fruits.
            identity_known: Whether frames hold no fruit but the target, so that none can be mistaken for it.
            device: Where tensors live.
        """
        self.num_envs = num_envs
        self.detector = detector
        """Finds and measures fruits."""
        self._identity_known = identity_known
        self._device = torch.device(device)
        self._trackers = [TargetTracker(np.zeros(3)) for _ in range(num_envs)]
        self._views: list[list[Measurement]] = [[] for _ in range(num_envs)]
        self._fruit: list[int | None] = [None] * num_envs

    def begin(
        self,
        env_index: int,
        position_w: Position,
        *,
        is_located: bool = False,
        hidden_below: float | None = None,
    ) -> None:
        """Forgets an environment's views and begins with a new target.

        Args:
            env_index: Which environment's.
            position_w: As for `TargetTracker`, like the others. Shape (3,).
            is_located: Whether it was measured.
            hidden_below: The first view shows less of the target than this V_f; None if that is not known.
        """
        self._trackers[env_index] = TargetTracker(
            position_w,
            is_located=is_located,
            hidden_below=hidden_below,
            identity_known=self._identity_known,
        )
        self.forget_views(env_index)

    def forget_views(self, env_index: int) -> None:
        """Forgets an environment's views but not where its target is believed to be."""
        self._views[env_index] = []
        self._fruit[env_index] = None

    def look(self, frames: Sequence[PosedFrame | None]) -> Tensor:
        """Measures new frames and finds the targets in them.

        Args:
            frames: One for each environment, None for those that do not look.

        Returns:
            The environments whose target was first located in this view: what they have seen before should be taken
            in again, about the new position, with `recall`. Shape (N,), bool.

        Raises:
            InvalidInputError: The number of frames is wrong, or one lacks what segmentation needs.
        """
        if len(frames) != self.num_envs:
            raise InvalidInputError(
                f"frames must be {self.num_envs}, one for each environment; got {len(frames)}"
            )
        located = self.is_located
        for k, frame in enumerate(frames):
            if frame is not None:
                self.add(k, self.detector.measure(frame))
        return self.is_located & ~located

    def add(self, env_index: int, measurement: Measurement) -> None:
        """Takes in a view that was measured already."""
        self._views[env_index].append(measurement)
        self._fruit[env_index] = self._trackers[env_index].update(measurement)

    def views(self, env_index: int) -> Sequence[Measurement]:
        """All views of an environment's target so far, in order."""
        return self._views[env_index]

    def target_fruit(self, env_index: int) -> int | None:
        """Index of the target among the fruits of the last view; None if it does not show it."""
        return self._fruit[env_index]

    def position_w(self, env_index: int) -> Position:
        """Where an environment's target is believed to be, world frame, in [m]. Shape (3,), float64."""
        return self._trackers[env_index].position_w

    @property
    def is_located(self) -> Tensor:
        """Whether the camera has measured where the targets are. Shape (N,), bool."""
        return torch.tensor([tracker.is_located for tracker in self._trackers], device=self._device)

    @property
    def target_position(self) -> Tensor:
        """Where targets are believed to be, world frame, in [m]. Shape (N, 3), float32."""
        positions = np.stack([tracker.position_w for tracker in self._trackers])
        return torch.as_tensor(positions, dtype=torch.float32, device=self._device)

    @property
    def visible_fraction(self) -> Tensor:
        """V_f of the targets in the last views, 0 for one that is not seen. Shape (N,), float32."""
        fractions = [0.0] * self.num_envs
        for k, fruit in enumerate(self._fruit):
            if fruit is not None and np.isfinite(v := self._views[k][-1].fruits[fruit].visible_fraction):
                fractions[k] = v
        return torch.tensor(fractions, dtype=torch.float32, device=self._device)

    def rays(self) -> ViewRays:
        """The pattern about the believed positions, read from the last views; OUTSIDE where there is none yet."""
        last = [views[-1] if views else None for views in self._views]
        return self._rays(list(zip(last, self._fruit, strict=True)))

    def recall(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Begins the memory of some environments anew about where their targets are believed to be now, and takes in
        what was seen before the last view.

        Args:
            observer: Whose memory.
            env_idx: Which environments. Shape (b,).
        """
        observer.begin(env_idx, self.target_position[env_idx])
        rows = [int(i) for i in env_idx]
        poses = torch.eye(4, device=self._device).repeat(self.num_envs, 1, 1)
        for k in range(max((len(self._views[i]) - 1 for i in rows), default=0)):
            seen: list[tuple[Measurement | None, int | None]] = [(None, None)] * self.num_envs
            for i in rows:
                if k < len(self._views[i]) - 1:
                    view = self._views[i][k]
                    seen[i] = (view, self._trackers[i].find(view))
                    poses[i] = torch.as_tensor(view.frame.T_world_camera).to(poses)
            mask = torch.tensor([view is not None for view, _ in seen], device=self._device)
            observer.memory.integrate(poses, self._rays(seen), mask)

    def _rays(self, seen: Sequence[tuple[Measurement | None, int | None]]) -> ViewRays:
        parts = [
            _NO_RAYS if view is None else view.rays(tracker.position_w, fruit)
            for tracker, (view, fruit) in zip(self._trackers, seen, strict=True)
        ]
        return ViewRays(
            torch.cat([part.direction_c for part in parts]).to(self._device),
            torch.cat([part.distance for part in parts]).to(self._device),
            torch.cat([part.label for part in parts]).to(self._device),
        )
