# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""What one ray meets of one mesh, be that Warp's or Embree's: the functions that all ray-casting kernels share.

A kernel calls Embree by the address of its function, and hands it the structs `RTCRay` and `RTCRayHit` of
`embree4/rtcore_ray.h`. Warp's kernels for CUDA are compiled without these lines.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

_FILL_RAY = """
    ray.origin[0] = origin[0]; ray.origin[1] = origin[1]; ray.origin[2] = origin[2];
    ray.direction[0] = direction[0]; ray.direction[1] = direction[1]; ray.direction[2] = direction[2];
    ray.nearest = 0.0f; ray.time = 0.0f; ray.farthest = farthest;
    ray.mask = 0xffffffffu; ray.id = 0u; ray.flags = 0u;
"""

_CLOSEST_HIT = f"""
    wp::vec_t<5, float> hit(-1.0f);
#if !defined(__CUDA_ARCH__)
    struct alignas(16) RayHit {{
        float origin[3], nearest, direction[3], time, farthest;
        unsigned mask, id, flags;
        float normal[3], u, v;
        unsigned face, geometry, instance[2];
    }} ray;
    {_FILL_RAY}
    ray.geometry = ray.instance[0] = ray.instance[1] = 0xffffffffu;
    ((void (*)(void*, RayHit*, void*)) function)((void*) mesh, &ray, nullptr);
    if (ray.geometry != 0xffffffffu) {{
        hit[0] = ray.farthest;
        for (int axis = 0; axis < 3; ++axis)
            hit[1 + axis] = ray.normal[axis];
        memcpy(&hit[4], &ray.face, sizeof(float));
    }}
#endif
    return hit;
"""

_ANY_HIT = f"""
#if defined(__CUDA_ARCH__)
    return false;
#else
    struct alignas(16) Ray {{
        float origin[3], nearest, direction[3], time, farthest;
        unsigned mask, id, flags;
    }} ray;
    {_FILL_RAY}
    // Embree marks a hit by a negative end, which a ray without length has from the beginning.
    if (!(farthest > 0.0f))
        return false;
    ((void (*)(void*, Ray*, void*)) function)((void*) mesh, &ray, nullptr);
    return ray.farthest < 0.0f;
#endif
"""

_RawHit = wp.types.vector(length=5, dtype=wp.float32)


@wp.struct
class Tracer:
    """The functions of Embree that trace rays, 0 for both where Warp does."""

    closest_hit: wp.uint64
    """Address of `rtcIntersect1`."""
    any_hit: wp.uint64
    """Address of `rtcOccluded1`."""


@wp.struct
class MeshHit:
    """Where a ray first meets a mesh."""

    found: bool
    """Whether it does."""
    distance: wp.float32
    """Parameter of the ray there."""
    normal: wp.vec3
    """Of the triangle, of any length."""
    face: wp.int32
    """Index of the triangle."""


@wp.func_native(_CLOSEST_HIT)
def embree_closest_hit(
    function: wp.uint64, mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, farthest: float
) -> _RawHit: ...


@wp.func_native(_ANY_HIT)
def embree_any_hit(
    function: wp.uint64, mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, farthest: float
) -> bool: ...


@wp.func
def closest_hit(
    tracer: Tracer, mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, farthest: float
) -> MeshHit:
    """The first triangle on a ray, from either side."""
    hit = MeshHit()
    if tracer.closest_hit != wp.uint64(0):
        raw = embree_closest_hit(tracer.closest_hit, mesh, origin, direction, farthest)
        hit.found = raw[0] >= 0.0
        hit.distance = raw[0]
        hit.normal = wp.vec3(raw[1], raw[2], raw[3])
        hit.face = wp.cast(raw[4], wp.int32)
    else:
        met = wp.mesh_query_ray(mesh, origin, direction, farthest)
        hit.found = met.result
        hit.distance = met.t
        hit.normal = met.normal
        hit.face = met.face
    return hit


@wp.func
def any_hit(tracer: Tracer, mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, farthest: float) -> bool:
    """Whether a ray meets any triangle, from either side."""
    if tracer.any_hit != wp.uint64(0):
        return embree_any_hit(tracer.any_hit, mesh, origin, direction, farthest)
    return wp.mesh_query_ray_anyhit(mesh, origin, direction, farthest)
