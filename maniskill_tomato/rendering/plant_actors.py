"""Plants as actors of a ManiSkill scene: one kinematic body, and so one segmentation id, per organ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.plants.materials import MATERIALS
from maniskill_tomato.plants.organs import MeshPart, Plant, joined_faces

if TYPE_CHECKING:
    import sapien
    import sapien.render
    from mani_skill.envs.scene import ManiSkillScene
    from mani_skill.utils.structs.actor import Actor


def repeating_texture(pixels: NDArray[np.uint8]) -> sapien.render.RenderTexture2D:
    """A texture of sRGB colours with alpha, Shape (rows, columns, 4), that repeats; needs a Vulkan device."""
    import sapien.render

    return sapien.render.RenderTexture2D(
        pixels, "R8G8B8A8Unorm", mipmap_levels=6, filter_mode="linear", address_mode="repeat", srgb=True
    )


def textured_material(
    pixels: NDArray[np.uint8], roughness: float, specular: float
) -> sapien.render.RenderMaterial:
    """A material with a repeating base colour; see `repeating_texture`."""
    import sapien.render

    result = sapien.render.RenderMaterial(base_color=[1, 1, 1, 1], roughness=roughness, specular=specular)
    result.base_color_texture = repeating_texture(pixels)
    return result


def make_render_shape(
    part: MeshPart, materials: dict[str, sapien.render.RenderMaterial]
) -> sapien.render.RenderShapeTriangleMesh:
    """A SAPIEN shape of a mesh part; needs a Vulkan device.

    Args:
        part: What to show.
        materials: Materials made so far, by name; a missing one is made and added. What keeps it keeps the part, too:
            the name of a file's own texture is its place in memory.
    """
    import sapien.render

    name = part.material if part.texture is None else f"{part.material} {id(part.texture)}"
    if name not in materials:
        made = MATERIALS[part.material]
        pixels = made.base_color if part.texture is None else part.texture
        materials[name] = textured_material(pixels, made.roughness, made.specular)
    vertices, normals, uvs, faces = part.vertices, part.normals, part.uvs, part.faces
    if part.two_sided:
        faces = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
        vertices, uvs = np.tile(vertices, (2, 1)), np.tile(uvs, (2, 1))
        normals = np.concatenate([normals, -normals])
    return sapien.render.RenderShapeTriangleMesh(
        vertices=vertices,
        triangles=faces.astype(np.uint32),
        normals=normals,
        uvs=uvs,
        material=materials[name],
    )


def merged_parts(parts: Sequence[MeshPart]) -> list[MeshPart]:
    """One part for each material and number of sides."""
    merged = []
    for material, two_sided in sorted({(part.material, part.two_sided) for part in parts}):
        same = [part for part in parts if (part.material, part.two_sided) == (material, two_sided)]
        merged.append(
            MeshPart(
                vertices=np.concatenate([part.vertices for part in same]),
                normals=np.concatenate([part.normals for part in same]),
                uvs=np.concatenate([part.uvs for part in same]),
                faces=joined_faces(same),
                material=material,
                two_sided=two_sided,
            )
        )
    return merged


def build_plant_actors(
    scene: ManiSkillScene, plant: Plant, *, scene_idxs: list[int], pose: sapien.Pose, name_prefix: str
) -> list[Actor]:
    """Puts a plant into some of a scene's sub-scenes.

    Every organ becomes a kinematic actor without collision shapes whose own frame is the plant's. A scene
    that cannot render gets the same actors without shapes, so segmentation ids (`per_scene_id`) agree between
    backends.

    Args:
        scene: Where to build.
        plant: What to build.
        scene_idxs: Indices of the sub-scenes that get this plant.
        pose: Pose of the plant's frame in the world.
        name_prefix: Put before every organ's name; with it, names must be unique in the scene.

    Returns:
        The actors in the order of `plant.organs`.
    """
    from mani_skill.utils.structs.pose import Pose

    materials: dict[str, sapien.render.RenderMaterial] = {}
    initial_pose = Pose.create(pose)
    actors = []
    for organ in plant.organs:
        builder = scene.create_actor_builder()
        builder.set_scene_idxs(scene_idxs)
        builder.initial_pose = initial_pose
        if scene.can_render():
            # ManiSkill's own builders hand over meshes made in memory in this way.
            builder._procedural_shapes.extend(make_render_shape(part, materials) for part in organ.parts)
        actors.append(builder.build_kinematic(f"{name_prefix}{organ.name}"))
    return actors
