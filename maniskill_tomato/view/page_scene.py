"""A snapshot of an episode as a three-dimensional scene of viser."""

import math
from typing import Any, Final

import numpy as np
import torch
import trimesh
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from maniskill_tomato.assets import asset_path
from maniskill_tomato.plants.organs import Organ, Plant
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import CAMERA_LINK_NAME, T_flange_camera
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.robot_description import link_meshes
from maniskill_tomato.view.episode_recording import (
    EpisodeRecording,
    Float64,
    Foliage,
    SeenPoints,
    Snapshot,
    Voxel,
)
from maniskill_tomato.view.plant_meshes import ColouredMesh, organ_meshes, plant_organs

LAYERS: Final[dict[str, bool]] = {
    "leaves": True,
    "neighbours": True,
    "arm": True,
    "picture": True,
    "rays": True,
    "candidates": True,
    "way": True,
    "other policies": True,
    "fruit map": True,
    "points": True,
    "blocked": False,
    "free": False,
    "unknown": False,
}
"""What can be shown or hidden, and whether it is shown at first."""

LAYERS_OF_RUNS: Final = ("arm", "picture", "way", "points")
"""Those that the recording of a run has something of."""

LAYERS_OF_RECORDS: Final = ("leaves", "neighbours", "arm", "picture", "way", "other policies")
"""Those that stored episodes of several policies have something of."""

LAYERS_OF_PLAY: Final = tuple(name for name in LAYERS if name not in ("other policies", "points"))
"""Those that an episode has something of which is played."""

Rgb = tuple[int, int, int]

TARGET_COLOUR: Final[Rgb] = (255, 190, 40)
CAMERA_COLOUR: Final[Rgb] = (30, 40, 60)
NEXT_COLOUR: Final[Rgb] = (40, 110, 220)
WAY_COLOUR: Final[Rgb] = (60, 70, 80)
SEEN_COLOUR: Final[Rgb] = (50, 160, 80)
HIDDEN_COLOUR: Final[Rgb] = (200, 50, 40)
VOXEL_COLOURS: Final[dict[Voxel, Rgb]] = {
    Voxel.BLOCKED: (176, 58, 46),
    Voxel.FREE: (90, 170, 235),
    Voxel.UNKNOWN: (120, 120, 128),
}
WORST: Final = np.array([68.0, 1.0, 84.0])
MIDDLE: Final = np.array([33.0, 145.0, 140.0])
BEST: Final = np.array([253.0, 231.0, 37.0])
"""Ends and middle of the scale of scores (viridis)."""

FRUSTUM_SCALE: Final = 0.12
"""Height of the wrist camera's frustum, in [m]."""

FRUSTUM_LINE: Final = 0.004
"""Thickness of its edges, in [m]."""

RAY_LINE: Final = 0.0015
"""Thickness of a ray, in [m]."""

WAY_LINE: Final = 0.006
"""Thickness of a camera's way, in [m]."""

FIELD_OF_VIEW: Final = math.radians(38.0)
"""Vertical, of the viewer's camera at first, in [rad]."""

BEST_SHOWN: Final = 24
"""Candidates that are drawn large; the others are small."""

NEIGHBOURS_IN_SMALL: Final = 0.3
"""Share of the neighbours' triangles in a small scene."""

GRAIN: Final = 2.0**-13
"""Positions are rounded to this, in [m], so that files pack well."""

FLOOR_SIZE: Final = 3.0
"""Edge of the floor, in [m]."""


class EpisodeScene:
    """Draws the snapshots of one recording after another."""

    def __init__(self, scene: viser.SceneApi, model: ArmModel = IIWA14, *, small: bool = False) -> None:
        """Puts up what no episode changes: light, floor, arm.

        Args:
            scene: Of a server, or of one client.
            model: Of the arm.
            small: Whether little is to be sent: a row's neighbours in fewer triangles, no free and unknown voxels.
        """
        self._scene = scene
        self._model = model
        self.visible = dict(LAYERS)
        """Which of `LAYERS` are shown."""
        self._small = small
        self._recording: EpisodeRecording | None = None
        self._shown: tuple[int, Snapshot] | None = None
        self._drawn_plant: Plant | None = None
        self._drawn_organs: dict[str, tuple[Organ, ...]] = {}
        self._plant = scene.add_frame("/plant", show_axes=False)
        self._handles: dict[str, list[Any]] = {name: [] for name in LAYERS}
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.configure_default_lights(False)
        scene.configure_environment_map("studio", environment_intensity=0.2)
        scene.add_light_hemisphere(
            "/light/sky", sky_color=(235, 242, 250), ground_color=(120, 112, 100), intensity=0.35
        )
        scene.add_light_directional(
            "/light/sun", color=(255, 246, 230), intensity=1.1, position=(-2.0, -1.5, 4.0), cast_shadow=True
        )
        scene.add_box(
            "/floor",
            color=(150, 152, 146),
            dimensions=(FLOOR_SIZE, FLOOR_SIZE, 0.01),
            position=(0.6, 0.0, -0.006),
            cast_shadow=False,
        )
        self._links = {name: self._add_link(name) for name in model.link_names}
        self._handles["arm"] = list(self._links.values())

    # ------------------------------------------------------------------ layers

    def show_layer(self, name: str, visible: bool) -> None:
        """Shows or hides one of `LAYERS`."""
        self.visible[name] = visible
        for handle in self._handles[name]:
            handle.visible = visible

    # ----------------------------------------------------------------- drawing

    def draw(self, recording: EpisodeRecording, shown: int, joints: Float64 | None = None) -> None:
        """Draws a snapshot.

        Args:
            recording: Which episode.
            shown: After how many moves; where there were fewer, the last snapshot is drawn.
            joints: Where the arm is shown, in [rad], if it is on its way there. Shape (7,).
        """
        snapshot = recording.at(shown)
        if recording is not self._recording:
            self._draw_plant(recording.plant)
            self._place_plant(recording)
            self._recording, self._shown = recording, None
        elif recording.plant is not self._drawn_plant:
            self._draw_plant(recording.plant)
        if self._shown != (shown, snapshot):
            self._shown = shown, snapshot
            self._draw_target(snapshot)
            self._draw_fruits(snapshot)
            self._draw_points(snapshot.points)
            self._draw_candidates(snapshot)
            self._draw_foliage(snapshot.foliage)
            self._draw_camera(recording, shown)
            self._draw_way(recording, shown)
            self._draw_other_ways(recording, shown)
            self._draw_rays(snapshot)
        self._move_arm(snapshot.joint_positions if joints is None else joints)

    def _draw_plant(self, plant: Plant | None) -> None:
        """Draws a plant in the place of the one before; parts of which no organ differs stay."""
        if plant is self._drawn_plant:
            return
        self._drawn_plant = plant
        organs = {} if plant is None else plant_organs(plant)
        for name in self._drawn_organs.keys() - organs.keys():
            self._scene.remove_by_name(f"/plant/{name}")
            self._handles[name] = []
        changed = {name: some for name, some in organs.items() if some != self._drawn_organs.get(name)}
        share = NEIGHBOURS_IN_SMALL if self._small else 1.0
        for name, mesh in organ_meshes(changed, share).items():
            handle = self._scene.add_glb(f"/plant/{name}", glb(mesh), visible=self.visible.get(name, True))
            if name in LAYERS:
                self._handles[name] = [handle]
        self._drawn_organs = organs

    def _place_plant(self, recording: EpisodeRecording) -> None:
        self._plant.wxyz, self._plant.position = pose(recording.T_w_plant)

    def _draw_target(self, snapshot: Snapshot) -> None:
        self._scene.add_icosphere(
            "/target",
            radius=0.042,
            color=TARGET_COLOUR,
            opacity=0.3,
            subdivisions=2,
            cast_shadow=False,
            receive_shadow=False,
            position=vector(snapshot.target_position),
        )

    def _draw_fruits(self, snapshot: Snapshot) -> None:
        self._scene.remove_by_name("/fruits")
        self._handles["fruit map"] = []
        for fruit in snapshot.fruits:
            colour = (
                TARGET_COLOUR if fruit.is_target else ((210, 60, 40) if fruit.is_ripe else (140, 180, 90))
            )
            self._handles["fruit map"].append(
                self._scene.add_icosphere(
                    f"/fruits/{fruit.number}",
                    radius=fruit.radius + fruit.spread,
                    color=colour,
                    wireframe=True,
                    subdivisions=1,
                    cast_shadow=False,
                    position=vector(fruit.position),
                    visible=self.visible["fruit map"],
                )
            )

    def _draw_points(self, points: SeenPoints | None) -> None:
        self._scene.remove_by_name("/points")
        self._handles["points"] = []
        if points is not None and len(points.positions):
            self._handles["points"].append(
                self._scene.add_point_cloud(
                    "/points",
                    points.positions,
                    points.colours,
                    point_size=0.003,
                    point_shape="square",
                    point_shading="flat",
                    precision="float32",
                    visible=self.visible["points"],
                )
            )

    def _draw_candidates(self, snapshot: Snapshot) -> None:
        self._scene.remove_by_name("/candidates")
        self._handles["candidates"] = []
        candidates = snapshot.candidates
        if candidates is None:
            return
        allowed = np.isfinite(candidates.worth)
        shown = self.visible["candidates"]
        order = np.argsort(-candidates.worth)[: int(allowed.sum())]
        colours = score_colours(candidates.worth[order])
        for name, part, size in (
            ("best", slice(None, BEST_SHOWN), 0.011),
            ("others", slice(BEST_SHOWN, None), 0.004),
        ):
            if len(order[part]):
                self._handles["candidates"].append(
                    self._scene.add_point_cloud(
                        f"/candidates/{name}",
                        candidates.positions[order[part]],
                        colours[part],
                        point_size=size,
                        point_shape="circle",
                        precision="float32",
                        visible=shown,
                    )
                )
        self._handles["candidates"].append(
            self._scene.add_icosphere(
                "/candidates/chosen",
                radius=0.016,
                color=NEXT_COLOUR,
                subdivisions=2,
                cast_shadow=False,
                position=vector(candidates.positions[candidates.chosen]),
                visible=shown,
            )
        )

    def _draw_foliage(self, foliage: Foliage | None) -> None:
        for kind in Voxel:
            name = kind.name.lower()
            self._scene.remove_by_name(f"/memory/{name}")
            self._handles[name] = []
            if foliage is None or (self._small and kind is not Voxel.BLOCKED):
                continue
            places = foliage.places(kind)
            if not len(places):
                continue
            if kind is Voxel.BLOCKED:
                handle: Any = self._scene.add_batched_meshes_simple(
                    "/memory/blocked",
                    *_cube(0.9 * foliage.cell_size),
                    batched_positions=places,
                    batched_wxyzs=np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (len(places), 1)),
                    batched_colors=VOXEL_COLOURS[kind],
                    opacity=0.45,
                    flat_shading=True,
                    cast_shadow=False,
                    receive_shadow=False,
                    lod="off",
                    visible=self.visible[name],
                )
            else:
                handle = self._scene.add_point_cloud(
                    f"/memory/{name}",
                    places,
                    VOXEL_COLOURS[kind],
                    point_size=0.004 if kind is Voxel.FREE else 0.003,
                    point_shape="circle",
                    point_shading="flat",
                    visible=self.visible[name],
                )
            self._handles[name] = [handle]

    def _draw_camera(self, recording: EpisodeRecording, shown: int) -> None:
        snapshot, picture = recording.at(shown), recording.picture(shown)
        height, width = picture.shape[:2]
        wxyz, position = pose(snapshot.T_w_camera)
        self._handles["picture"] = [
            self._scene.add_camera_frustum(
                "/camera",
                fov=recording.fov_y,
                aspect=width / height,
                scale=FRUSTUM_SCALE,
                thickness=FRUSTUM_LINE,
                color=colour_of(recording, CAMERA_COLOUR),
                image=picture,
                format="jpeg",
                jpeg_quality=85,
                cast_shadow=False,
                wxyz=wxyz,
                position=position,
                visible=self.visible["picture"],
            )
        ]
        self._scene.remove_by_name("/next")
        self._handles["way"] = []
        if snapshot.T_w_camera_next is not None:
            wxyz, position = pose(snapshot.T_w_camera_next)
            self._handles["way"].append(
                self._scene.add_camera_frustum(
                    "/next",
                    fov=recording.fov_y,
                    aspect=width / height,
                    scale=0.5 * FRUSTUM_SCALE,
                    thickness=FRUSTUM_LINE,
                    color=NEXT_COLOUR,
                    cast_shadow=False,
                    wxyz=wxyz,
                    position=position,
                    visible=self.visible["way"],
                )
            )

    def _draw_way(self, recording: EpisodeRecording, shown: int) -> None:
        self._scene.remove_by_name("/way")
        steps = _steps(recording, shown)
        if len(steps):
            self._handles["way"].append(
                self._scene.add_line_segments(
                    "/way",
                    steps,
                    colour_of(recording, WAY_COLOUR),
                    thickness=WAY_LINE,
                    visible=self.visible["way"],
                )
            )

    def _draw_other_ways(self, recording: EpisodeRecording, shown: int) -> None:
        """The ways of the other policies, each with a frustum where its camera stands after as many moves."""
        self._scene.remove_by_name("/others")
        self._handles["other policies"] = []
        for index, way in enumerate(recording.ways):
            if way.recording is recording:
                continue
            wxyz, position = pose(way.recording.at(shown).T_w_camera)
            height, width = way.recording.picture(shown).shape[:2]
            frustum = self._scene.add_camera_frustum(
                f"/others/{index}/camera",
                fov=recording.fov_y,
                aspect=width / height,
                scale=0.7 * FRUSTUM_SCALE,
                thickness=FRUSTUM_LINE,
                color=way.colour,
                cast_shadow=False,
                wxyz=wxyz,
                position=position,
                visible=self.visible["other policies"],
            )
            self._handles["other policies"].append(frustum)
            steps = _steps(way.recording, shown)
            if len(steps):
                line = self._scene.add_line_segments(
                    f"/others/{index}/way",
                    steps,
                    way.colour,
                    thickness=WAY_LINE,
                    visible=self.visible["other policies"],
                )
                self._handles["other policies"].append(line)

    def _draw_rays(self, snapshot: Snapshot) -> None:
        """Rays to the target: those that reach it, and those that something stops."""
        self._scene.remove_by_name("/rays")
        self._handles["rays"] = []
        rays = snapshot.rays
        if rays is None or not len(rays.ends):
            return
        start = np.broadcast_to(snapshot.T_w_camera[:3, 3].astype(np.float32), rays.ends.shape)
        colours = np.where(rays.is_seen[:, None], SEEN_COLOUR, HIDDEN_COLOUR).astype(np.uint8)
        self._handles["rays"].append(
            self._scene.add_line_segments(
                "/rays",
                np.stack([start, rays.ends], axis=1),
                np.repeat(colours[:, None], 2, axis=1),
                thickness=RAY_LINE,
                visible=self.visible["rays"],
            )
        )

    def _move_arm(self, joints: Float64) -> None:
        links = link_transforms(torch.as_tensor(np.array(joints))[None], self._model)[0].numpy()
        for T, handle in zip(links, self._links.values(), strict=True):
            handle.wxyz, handle.position = pose(T)

    def _add_link(self, name: str) -> Any:
        """A link of the arm; the flange carries the camera's housing."""
        if self._model is not IIWA14:
            vertices, faces = link_meshes(self._model)[name]
            return self._scene.add_mesh_simple(f"/arm/{name}", vertices, faces, color=(206, 206, 208))
        handle = self._scene.add_glb(f"/arm/{name}", asset_path(f"iiwa14/meshes/{name}.glb").read_bytes())
        if name == self._model.flange_link:
            wxyz, position = pose(T_flange_camera)
            housing = asset_path(f"iiwa14/meshes/{CAMERA_LINK_NAME}.glb").read_bytes()
            self._scene.add_glb(f"/arm/{name}/camera", housing, wxyz=wxyz, position=position)
        return handle


def colour_of(recording: EpisodeRecording, alone: Rgb) -> Rgb:
    """The colour of a policy that is drawn beside others; `alone` if there are none."""
    return next((way.colour for way in recording.ways if way.recording is recording), alone)


def _steps(recording: EpisodeRecording, shown: int) -> NDArray[np.float32]:
    """The camera's way as segments, in the world frame, in [m]. Shape (moves, 2, 3)."""
    way = np.array([s.T_w_camera[:3, 3] for s in recording.snapshots[: shown + 1]], dtype=np.float32)
    return np.stack([way[:-1], way[1:]], axis=1)


def first_view(recording: EpisodeRecording) -> tuple[Float64, Float64]:
    """Where a viewer stands, and where it looks, so that arm and plant fill the picture: world frame, in [m]."""
    seen = recording.snapshots[0].target_position if recording.plant is None else recording.T_w_plant[:3, 3]
    middle = np.array([0.5 * seen[0], 0.5 * seen[1], 0.75])
    return middle + np.array([-1.6, -2.4, 0.9]), middle


def score_colours(worth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours from the worst (dark) to the best (yellow). Shape (n,) to (n, 3)."""
    if not len(worth):
        return np.zeros((0, 3), dtype=np.uint8)
    low, high = float(worth.min()), float(worth.max())
    share = ((worth - low) / max(high - low, 1e-9))[:, None].astype(np.float64)
    below = WORST + 2.0 * share * (MIDDLE - WORST)
    above = MIDDLE + (2.0 * share - 1.0) * (BEST - MIDDLE)
    colours: NDArray[np.uint8] = np.where(share < 0.5, below, above).round().astype(np.uint8)
    return colours


def pose(T: Float64) -> tuple[tuple[float, float, float, float], tuple[float, float, float]]:
    """Quaternion, w first, and position of a pose of shape (4, 4)."""
    w, x, y, z = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True).tolist()
    return (w, x, y, z), vector(T[:3, 3])


def vector(values: NDArray[Any]) -> tuple[float, float, float]:
    """Three numbers."""
    x, y, z = (float(v) for v in values)
    return x, y, z


def glb(mesh: ColouredMesh) -> bytes:
    """The mesh as a GLB file, matt, drawn from both sides."""
    share = mesh.colours / 255.0
    # glTF's colours of vertices are linear light.
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    colours = np.column_stack([np.round(255.0 * linear), np.full(len(share), 255.0)]).astype(np.uint8)
    visual: Any = TextureVisuals(
        material=PBRMaterial(roughnessFactor=0.8, metallicFactor=0.0, doubleSided=True)
    )
    visual.vertex_attributes["color"] = colours
    shape: Any = trimesh.Trimesh(
        np.round(mesh.vertices / GRAIN) * GRAIN,
        mesh.faces,
        vertex_normals=np.round(64.0 * mesh.normals) / 64.0,
        visual=visual,
        process=False,
    )
    content: bytes = shape.export(file_type="glb", include_normals=True)
    return content


def _cube(edge: float) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    box: Any = trimesh.creation.box((edge, edge, edge))
    return np.asarray(box.vertices, dtype=np.float32), np.asarray(box.faces, dtype=np.uint32)
