#version 430 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "rays": the views of some texels by rays that follow the cosine, one invocation a ray: what each meets, as an
// entry, into the texel's tile. Local space.
//
// Rays are a Hammersley set, shifted for each texel (Cranley and Patterson 1976); each starts at one of the texel's
// points that lie in the open.
#ifndef RAYS_TEXELS
#error Required define RAYS_TEXELS: the binding of the texels, e.g. 3
#endif
#ifndef RAYS_SIDES
#error Required define RAYS_SIDES: the binding of the triangles' sides, e.g. 4
#endif
#ifndef RAYS_NORMALS
#error Required define RAYS_NORMALS: the binding of the triangles' normals, e.g. 5
#endif
#ifndef RAYS_SIZE
#error Required define RAYS_SIZE: rays along a tile, of which it has RAYS_SIZE², a multiple of 8
#endif

#include "inc/bvh.glsl"
#include "inc/sky.glsl"

layout(local_size_x = 64) in;

const int POINTS = 8; // must match rasterise.POINTS

struct Texel {
    vec4 points[POINTS]; // those in the open first
    vec4 tangent;        // fourth: how many points lie in the open
    vec4 normal;         // shading; fourth: this texel's shift along the ring
    vec4 own;            // of its own triangle; fourth: this texel's shift across rings
    ivec4 tile;          // left and bottom in the target, pixels
};

// Of one side of a triangle: page pixel of the first corner and what it grows by along u and v; the page's first pixel,
// -1 where the side has no map.
struct Side {
    vec2 first_corner;
    vec2 along_u;
    vec2 along_v;
    int first_pixel;
    int unused;
};

layout(std430, binding = RAYS_TEXELS) readonly buffer Texels { Texel texels[]; };
layout(std430, binding = RAYS_SIDES) readonly buffer Sides { Side sides[]; };
layout(std430, binding = RAYS_NORMALS) readonly buffer Normals { vec4 normals[]; };
layout(r32ui, binding = 0) writeonly uniform uimage2D entries;

uniform int resolution; // of an atlas page
uniform int triangles;  // sides of backs follow those of all fronts
uniform uint none;      // the entry of what has no light
uniform float far;      // farther than anything

// 0.d0 d1 d2 ... of the base's digits of i, the last first: which point a ray starts from must not hang on its direction.
float digits_reversed(uint i, uint base)
{
    float value = 0.0, place = 1.0;
    for (; i > 0u; i /= base) {
        place /= float(base);
        value += place * float(i % base);
    }
    return value;
}

uint entry_of(Hit hit, vec3 way)
{
    if (hit.triangle < 0)
        return sky_entry(way);
    bool back = dot(normals[hit.triangle].xyz, way) > 0.0;
    Side side = sides[hit.triangle + (back ? triangles : 0)];
    if (side.first_pixel < 0)
        return none;
    vec2 at = side.first_corner + side.along_u * hit.u + side.along_v * hit.v;
    ivec2 cell = clamp(ivec2(at), 0, resolution - 1);
    return uint(side.first_pixel + cell.y * resolution + cell.x);
}

void main()
{
    const uint count = uint(RAYS_SIZE * RAYS_SIZE);
    uint ray = gl_GlobalInvocationID.x;
    Texel texel = texels[gl_WorkGroupID.y];
    float across = fract((float(ray) + 0.5) / float(count) + texel.own.w);
    float angle = 6.28318530717959 * fract(float(bitfieldReverse(ray) >> 8) / 16777216.0 + texel.normal.w);
    float ring = sqrt(across);
    vec3 way = ring * cos(angle) * texel.tangent.xyz + ring * sin(angle) * cross(texel.normal.xyz, texel.tangent.xyz)
        + sqrt(max(1.0 - across, 0.0)) * texel.normal.xyz;
    int start = min(int(digits_reversed(ray, 3u) * texel.tangent.w), POINTS - 1);
    uint entry = none;
    if (dot(way, texel.own.xyz) > 0.0)
        entry = entry_of(nearest_hit(texel.points[start].xyz, way, far), way);
    imageStore(entries, texel.tile.xy + ivec2(ray % uint(RAYS_SIZE), ray / uint(RAYS_SIZE)), uvec4(entry));
}
