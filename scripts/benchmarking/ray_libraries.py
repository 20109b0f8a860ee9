# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportOptionalSubscript=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Libraries that trace rays on a CPU, and whole steps with Embree and with Warp.

Rates are per second of processor time of this process, and medians of measurements taken in turns.
"""

import importlib
import statistics
import time
from collections.abc import Callable
from typing import Any, Final
from unittest import mock

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast import scene
from maniskill_tomato.raycast.embree import Backend, load_embree
from maniskill_tomato.raycast.mesh_rays import Tracer, any_hit, closest_hit
from maniskill_tomato.raycast.meshes import build_mesh
from maniskill_tomato.raycast.warp_scene import WarpScene
from maniskill_tomato.tasks.vector_env import VectorEnv, make_vector_env

Floats = NDArray[np.float32]
Query = Callable[[Floats, Floats], NDArray[Any]]
"""Origins and unit directions, each of shape (R, 3), to the distance of the first hit, 0 or more, or to whether there
is any. Shape (R,)."""

BATCHES: Final = (256, 200_000)
"""Rays a query."""
CAMERA_DISTANCE: Final = 0.4
"""From the fruits, in [m]."""
FARTHEST: Final = 1.5
"""Length of the rays, in [m]."""
TASKS: Final = ("TomatoViewpointGuided-v1", "TomatoViewpoint-v1")
BACKENDS: Final[tuple[Backend, ...]] = ("warp", "embree")


@wp.kernel(enable_backward=False)
def trace_closest(
    tracer: Tracer,
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    distances: wp.array[wp.float32],
):
    """The distance of the first hit, -1 without one."""
    ray = wp.tid()
    hit = closest_hit(tracer, mesh, origins[ray], directions[ray], FARTHEST)
    distance = wp.float32(-1.0)
    if hit.found:
        distance = hit.distance
    distances[ray] = distance


@wp.kernel(enable_backward=False)
def trace_any(
    tracer: Tracer,
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    met: wp.array[wp.int32],
):
    """1 where a ray meets anything."""
    ray = wp.tid()
    met[ray] = wp.int32(any_hit(tracer, mesh, origins[ray], directions[ray], FARTHEST))


def kernel_queries(plant: Plant, backend: Backend) -> tuple[Query, Query]:
    """Closest and any hit as this package's kernels ask for them."""
    mesh, tracer = build_mesh(plant.vertices, plant.faces, "cpu", backend), Tracer()
    embree = load_embree()
    if backend == "embree" and embree is not None:
        tracer.closest_hit, tracer.any_hit = embree.closest_hit, embree.any_hit

    def query(kernel: Any, kind: Any) -> Query:
        def ask(origins: Floats, directions: Floats) -> NDArray[Any]:
            rays = [wp.array(a, dtype=wp.vec3, device="cpu", copy=False) for a in (origins, directions)]
            answers = wp.empty(len(origins), dtype=kind, device="cpu")
            wp.launch(kernel, len(origins), [tracer, mesh.id, *rays, answers], device="cpu")
            return np.asarray(answers.numpy())

        return ask

    return query(trace_closest, wp.float32), query(trace_any, wp.int32)


def embreex_queries(plant: Plant) -> tuple[Query, Query] | None:
    """The same by embreex's own interface; None where it is not installed."""
    try:
        construction = importlib.import_module("embreex.mesh_construction")
        rtcore = importlib.import_module("embreex.rtcore_scene")
    except ImportError:
        return None
    embreex_scene = rtcore.EmbreeScene()
    mesh = construction.TriangleMesh(embreex_scene, plant.vertices[plant.faces].astype(np.float32))

    def ask(query: str, origins: Floats, directions: Floats) -> NDArray[Any]:
        assert mesh is not None  # The scene does not keep it.
        limits = np.full(len(origins), FARTHEST, np.float32)
        return np.asarray(embreex_scene.run(origins, directions, query=query, dists=limits))

    def closest(origins: Floats, directions: Floats) -> NDArray[Any]:
        distances = ask("DISTANCE", origins, directions)
        return np.where(distances < FARTHEST, distances, -1.0)

    return closest, lambda origins, directions: ask("OCCLUDED", origins, directions) == 0


def open3d_queries(plant: Plant) -> tuple[Query, Query] | None:
    """The same by Open3D; None where it is not installed."""
    try:
        open3d = importlib.import_module("open3d")
    except ImportError:
        return None
    open3d_scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    open3d_scene.add_triangles(plant.vertices.astype(np.float32), plant.faces.astype(np.uint32))

    def rays(origins: Floats, directions: Floats) -> Any:
        return open3d.core.Tensor(np.concatenate([origins, directions], axis=1))

    def closest(origins: Floats, directions: Floats) -> NDArray[Any]:
        distances = open3d_scene.cast_rays(rays(origins, directions), nthreads=1)["t_hit"].numpy()
        return np.where(distances < FARTHEST, distances, -1.0)

    def occluded(origins: Floats, directions: Floats) -> NDArray[Any]:
        answers = open3d_scene.test_occlusions(rays(origins, directions), 0.0, FARTHEST, nthreads=1)
        return np.asarray(answers.numpy())

    return closest, occluded


def rays_at_fruits(plant: Plant, count: int) -> tuple[Floats, Floats]:
    """Origins and unit directions of rays at the fruits of a plant, 256 from every camera."""
    rng = np.random.default_rng(0)
    centres = np.array([fruit.centre for fruit in plant.fruits])
    cameras = -(-count // 256)
    fruits = rng.integers(len(centres), size=cameras)
    away = rng.normal(size=(cameras, 3))
    away *= CAMERA_DISTANCE / np.linalg.norm(away, axis=1, keepdims=True)
    origins = np.repeat(centres[fruits] + away, 256, axis=0)[:count]
    points = np.repeat(centres[fruits], 256, axis=0)[:count] + rng.normal(0.0, 0.015, (count, 3))
    directions = points - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def compare_libraries(repeats: int) -> list[dict[str, Any]]:
    """Rates of every library that is installed, and how far its answers are from Warp's."""
    plant = generate_plant("full", 0)
    libraries = {
        "warp": kernel_queries(plant, "warp"),
        "embree": kernel_queries(plant, "embree"),
        "embreex": embreex_queries(plant),
        "open3d": open3d_queries(plant),
    }
    rows = []
    for batch in BATCHES:
        rays = rays_at_fruits(plant, batch)
        calls = max(1, 100_000 // batch)
        answers: dict[str, list[NDArray[Any]]] = {}
        rates: dict[str, list[list[float]]] = {}
        for _ in range(repeats):
            for name, queries in libraries.items():
                if queries is None:
                    continue
                answers[name] = [query(*rays) for query in queries]
                rates.setdefault(name, []).append([])
                for query in queries:
                    start = time.process_time()
                    for _ in range(calls):
                        query(*rays)
                    rates[name][-1].append(calls * batch / (time.process_time() - start))
        warp_closest, warp_any = answers["warp"]
        for name, (closest, met) in answers.items():
            on_both = (closest >= 0.0) & (warp_closest >= 0.0)
            speeds = np.median(np.array(rates[name]), axis=0)
            rows.append(
                {
                    "library": name,
                    "triangles": len(plant.faces),
                    "rays_a_query": batch,
                    "closest_per_s": round(float(speeds[0])),
                    "any_per_s": round(float(speeds[1])),
                    "other_hits": int(((closest >= 0.0) != (warp_closest >= 0.0)).sum()),
                    "other_any_hits": int((met.astype(bool) != warp_any.astype(bool)).sum()),
                    "largest_difference_m": float(np.abs(closest - warp_closest)[on_both].max()),
                }
            )
    return rows


class RayClock:
    """Counts the processor time that scenes spend on queries."""

    def __init__(self) -> None:
        self.spent = 0.0
        """In [s]."""
        for name in ("visibility", "view_rays", "clearance"):
            setattr(WarpScene, name, self._timed(getattr(WarpScene, name)))

    def _timed(self, query: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any) -> Any:
            start = time.process_time()
            answer = query(*args)
            self.spent += time.process_time() - start
            return answer

        return timed


def made_with(backend: Backend, env_id: str, envs: int) -> VectorEnv:
    """Environments whose rays a library traces."""
    with mock.patch.object(scene, "choose_backend", lambda device, wanted: backend):
        env = make_vector_env(env_id, envs, autoreset_mode="Disabled", arrays="torch")
    env.reset(seed=0)
    return env


def compare_steps(counts: tuple[int, ...], repeats: int) -> list[dict[str, Any]]:
    """Steps a second with either library, and which share of a step is rays."""
    clock = RayClock()
    rows = []
    for env_id in TASKS:
        for count in counts:
            envs = {backend: made_with(backend, env_id, count) for backend in BACKENDS}
            steps, size = max(4, 128 // count), envs["warp"].single_action_space.shape[0]
            times: dict[str, list[float]] = {backend: [] for backend in BACKENDS}
            shares: dict[str, list[float]] = {backend: [] for backend in BACKENDS}
            for repeat in range(-1, repeats):
                rng = np.random.default_rng(repeat + 1)
                actions = torch.from_numpy(rng.uniform(-0.05, 0.05, (steps, count, size)).astype(np.float32))
                for backend, env in envs.items():
                    clock.spent, start = 0.0, time.process_time()
                    for action in actions:
                        env.step(action)
                    spent = time.process_time() - start
                    if repeat >= 0:  # The first round compiles and records.
                        times[backend].append(spent / steps)
                        shares[backend].append(clock.spent / spent)
            warp, embree = (statistics.median(times[backend]) for backend in BACKENDS)
            rows.append(
                {
                    "task": env_id,
                    "envs": count,
                    "warp_steps_per_s": round(count / warp),
                    "embree_steps_per_s": round(count / embree),
                    "embree_over_warp": round(warp / embree, 2),
                    "share_of_rays_warp": round(statistics.median(shares["warp"]), 2),
                    "share_of_rays_embree": round(statistics.median(shares["embree"]), 2),
                }
            )
    return rows
