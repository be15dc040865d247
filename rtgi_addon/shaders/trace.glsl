#version 430 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Traces rays: backend/gpu/compute_tracer.py. Local space.
//
// In:  the scene, see inc/bvh.glsl; at TRACE_RAYS, Ray[]; uniform ray_count.
// Out: at TRACE_RESULTS, in the rays' order: Hit[]; or with TRACE_ANY 1, uint[]: the kind of part that is in the way
//      before the ray's limit, 0 for none.
// One invocation a ray, TRACE_GROUP of them a group: dispatch ceil(ray_count / TRACE_GROUP).
#ifndef TRACE_RAYS
#error TRACE_RAYS: the binding of the rays, e.g. 3
#endif
#ifndef TRACE_RESULTS
#error TRACE_RESULTS: the binding of the results, e.g. 4
#endif
#ifndef TRACE_GROUP
#error TRACE_GROUP: rays of a group, e.g. 64
#endif
#ifndef TRACE_ANY
#error TRACE_ANY: 1 for what blocks a ray, 0 for its nearest hit
#endif

#include "inc/bvh.glsl"

layout(local_size_x = TRACE_GROUP) in;

struct Ray {
    vec3 origin;
    float limit;  // in units of the direction's length
    vec3 direction;
    float unused;
};

uniform uint ray_count;

layout(std430, binding = TRACE_RAYS) readonly buffer Rays { Ray rays[]; };
#if TRACE_ANY
layout(std430, binding = TRACE_RESULTS) writeonly buffer Results { uint blocker[]; };
#else
layout(std430, binding = TRACE_RESULTS) writeonly buffer Results { Hit hits[]; };
#endif

void main() {
    uint row = gl_GlobalInvocationID.x;
    if (row >= ray_count) return;
    Ray ray = rays[row];
#if TRACE_ANY
    blocker[row] = blocked(ray.origin, ray.direction, ray.limit);
#else
    hits[row] = nearest_hit(ray.origin, ray.direction, ray.limit);
#endif
}
