// SPDX-License-Identifier: GPL-3.0-or-later
// Rays against the scene's triangles, for compute passes (430). Local space; made by backend/gpu/bvh.py and
// backend/gpu/compute_tracer.py, which own the layouts.
//
// Storage buffers, std430, read only, bound where these required defines say (ComputeTracer.defines, .bind):
//   BVH_NODES      Node[]: the nodes of all hierarchies, one after another
//   BVH_TRIANGLES  Triangle[]: the triangles of their leaves
//   BVH_PARTS      uvec4 (number of parts, 0, 0, 0), then Part[]: what stays put, then every mover that rays can hit
// BVH_STACK: nodes on the longest way down, which the builder keeps to.
// BVH_CULL_MARGIN: share by which a part's sphere is taken wider, CULL_MARGIN of backend/surface/tracing.py.
//
// Use: Hit nearest_hit(origin, direction, limit), uint blocked(origin, direction, limit).
#ifndef BVH_NODES
#error BVH_NODES: the binding of the nodes, e.g. 0
#endif
#ifndef BVH_TRIANGLES
#error BVH_TRIANGLES: the binding of the triangles, e.g. 1
#endif
#ifndef BVH_PARTS
#error BVH_PARTS: the binding of the parts, e.g. 2
#endif
#ifndef BVH_STACK
#error BVH_STACK: nodes on the longest way down, e.g. 40
#endif
#ifndef BVH_CULL_MARGIN
#error BVH_CULL_MARGIN: share by which spheres are taken wider, e.g. 1e-4
#endif

// A link is the row of a node; or, negative, ~(8 * first + count): triangles from row first on.
struct Node {
    vec3 left_low;
    int left;
    vec3 left_high;
    int right;
    vec3 right_low;
    float unused_low;
    vec3 right_high;
    float unused_high;
};

struct Triangle {
    vec3 a;
    int number;  // scene-wide
    vec3 b;
    float unused_b;
    vec3 c;
    float unused_c;
};

// One hierarchy, in a space of its own: own = turn * (local - centre) + shift.
struct Part {
    vec4 turn_x;  // a row of turn, then shift.x
    vec4 turn_y;
    vec4 turn_z;
    vec3 centre;  // local, of a sphere around the part: the difference to it is what float32 holds well
    int root;
    vec3 low;  // bounds, own space
    uint kind;  // what blocked() answers
    vec3 high;
    float radius;  // of that sphere
};

struct Hit {
    int triangle;  // scene-wide; -1: the ray escaped
    float u;  // barycentric weight of the second corner
    float v;  // barycentric weight of the third corner
    float distance;  // in units of the direction's length; the limit where the ray escaped
};

layout(std430, binding = BVH_NODES) readonly buffer BvhNodes { Node bvh_nodes[]; };
layout(std430, binding = BVH_TRIANGLES) readonly buffer BvhTriangles { Triangle bvh_triangles[]; };
layout(std430, binding = BVH_PARTS) readonly buffer BvhParts { uvec4 bvh_part_count; Part bvh_parts[]; };

// A direction's component below this share of its largest one counts as this share: 1 / 0 would make 0 * inf.
const float BVH_LEAST_SLOPE = 1e-18;
// Woop13 section 3.3: the sheared corners err by 5 half steps of |x| + |z|, so boxes are met by as much beside them.
const float BVH_SHEAR_ERROR = 10.0 / 16777216.0;

const float BVH_HUGE = 3e38;  // what neither infinity nor NaN is below

// A ray in a part's own space, with what all boxes and all triangles need of it.
struct BvhRay {
    vec3 origin;
    vec3 inverse;  // 1 / direction
    vec3 slack;  // by how much boxes are entered earlier and left later, per axis
    uint axis;  // of the direction's largest component
    vec2 shear;
    float scale;
};

// v with the direction's largest component last.
vec3 bvh_turned(vec3 v, uint axis) { return axis == 2u ? v : axis == 0u ? v.yzx : v.zxy; }

BvhRay bvh_ray(Part part, vec3 origin, vec3 direction) {
    BvhRay ray;
    vec3 from = origin - part.centre;
    ray.origin = vec3(dot(part.turn_x.xyz, from), dot(part.turn_y.xyz, from), dot(part.turn_z.xyz, from))
        + vec3(part.turn_x.w, part.turn_y.w, part.turn_z.w);
    vec3 way = vec3(dot(part.turn_x.xyz, direction), dot(part.turn_y.xyz, direction), dot(part.turn_z.xyz, direction));
    vec3 size = abs(way);
    ray.axis = size.x > size.y ? (size.x > size.z ? 0u : 2u) : (size.y > size.z ? 1u : 2u);
    vec3 turned = bvh_turned(way, ray.axis);
    ray.shear = turned.xy / turned.z;
    ray.scale = 1.0 / turned.z;
    float least = abs(turned.z) * BVH_LEAST_SLOPE;
    ray.inverse = 1.0 / mix(way, vec3(least), lessThan(size, vec3(least)));
    vec3 away = max(abs(part.low - ray.origin), abs(part.high - ray.origin));
    ray.slack = abs(ray.inverse) * (BVH_SHEAR_ERROR * max(away.x, max(away.y, away.z)));
    return ray;
}

// Where the ray enters the box; negative: it does not before limit.
float bvh_enters(BvhRay ray, vec3 low, vec3 high, float limit) {
    vec3 a = (low - ray.origin) * ray.inverse, b = (high - ray.origin) * ray.inverse;
    vec3 near = min(a, b) - ray.slack, far = max(a, b) + ray.slack;
    float enter = max(max(near.x, near.y), max(near.z, 0.0));
    float leave = min(min(far.x, far.y), min(far.z, limit));
    return enter <= leave ? enter : -1.0;
}

// What a product lost by rounding: exact, after Dekker 1971. Not every device that has fma() fuses.
float bvh_lost(float a, float b, float product) {
    precise float c = 4097.0 * a, d = 4097.0 * b;
    precise float a_high = c - (c - a), b_high = d - (d - b);
    precise float a_low = a - a_high, b_low = b - b_high;
    precise float lost = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low;
    return lost;
}

// Twice the area between two sheared corners and the ray. Its sign is exact, and turns exactly with their order: a ray
// beside an edge is on the same side of it for both triangles there. `precise` keeps products from being fused.
float bvh_edge(vec2 p, vec2 q) {
    precise float first = p.x * q.y, second = p.y * q.x;
    precise float area = first - second;
    if (area == 0.0) {
        precise float lost = bvh_lost(p.x, q.y, first) - bvh_lost(p.y, q.x, second);
        area = lost;
    }
    return area;
}

// Corner relative to the ray's origin, sheared so that the ray is the z axis.
vec3 bvh_sheared(BvhRay ray, vec3 corner) {
    vec3 p = bvh_turned(corner - ray.origin, ray.axis);
    precise float x = p.x - ray.shear.x * p.z, y = p.y - ray.shear.y * p.z;
    return vec3(x, y, p.z);
}

// Woop, Benthin and Wald 2013: watertight, both sides. True: the triangle is hit before best, which it replaces.
bool bvh_meets(BvhRay ray, Triangle triangle, inout Hit best) {
    vec3 a = bvh_sheared(ray, triangle.a), b = bvh_sheared(ray, triangle.b), c = bvh_sheared(ray, triangle.c);
    float u = bvh_edge(c.xy, b.xy), v = bvh_edge(a.xy, c.xy), w = bvh_edge(b.xy, a.xy);
    if (min(u, min(v, w)) < 0.0 && max(u, max(v, w)) > 0.0) return false;
    precise float sum = u + v + w;
    if (sum == 0.0) return false;
    precise float along = (u * a.z + v * b.z + w * c.z) * ray.scale / sum;
    if (!(along > 0.0 && along < best.distance)) return false;
    best = Hit(triangle.number, v / sum, w / sum, along);
    return true;
}

bool bvh_leaf(BvhRay ray, int link, inout Hit best, const bool first_only) {
    int first = ~link >> 3, end = first + (~link & 7);
    bool met = false;
    for (int row = first; row < end && !(first_only && met); row++) {
        if (bvh_meets(ray, bvh_triangles[row], best)) met = true;
    }
    return met;
}

// Down one part's hierarchy, the nearer child first. first_only: one hit is enough, whichever.
bool bvh_walk(BvhRay ray, int root, inout Hit best, const bool first_only) {
    int stack[BVH_STACK];
    int top = 0, at = root;
    bool met = false;
    while (true) {
        Node node = bvh_nodes[at];
        float left = bvh_enters(ray, node.left_low, node.left_high, best.distance);
        float right = bvh_enters(ray, node.right_low, node.right_high, best.distance);
        if (left >= 0.0 && node.left < 0) {
            if (bvh_leaf(ray, node.left, best, first_only)) met = true;
            left = -1.0;
        }
        if (right >= 0.0 && node.right < 0) {
            if (bvh_leaf(ray, node.right, best, first_only)) met = true;
            right = -1.0;
        }
        if (first_only && met) return true;
        if (left >= 0.0 && right >= 0.0) {
            bool left_first = left <= right;
            stack[top++] = left_first ? node.right : node.left;
            at = left_first ? node.left : node.right;
        } else if (left >= 0.0 || right >= 0.0) {
            at = left >= 0.0 ? node.left : node.right;
        } else {
            if (top == 0) return met;
            at = stack[--top];
        }
    }
    return met;
}

// May the part be met before limit? Asked of its sphere first: a flat mover's space has lost a dimension, so rays that
// pass far from it look there as if they came by. A ray that is not finite meets nothing.
bool bvh_near(Part part, vec3 origin, vec3 direction, float limit) {
    vec3 away = part.centre - origin;
    float along = dot(away, direction), size = dot(direction, direction), apart = dot(away, away);
    float square = part.radius * part.radius;
    bool beside = apart * size - along * along <= (square + BVH_CULL_MARGIN * apart) * size;
    bool reached = along > 0.0 && along - part.radius * sqrt(size) <= limit * size;
    return apart <= square || (beside && reached);
}

// The same of its box; also not by a direction that vanishes in the part's space.
bool bvh_near_box(BvhRay ray, Part part, float limit) {
    bool sound = abs(ray.scale) < BVH_HUGE && abs(ray.origin.x + ray.origin.y + ray.origin.z) < BVH_HUGE;
    return sound && bvh_enters(ray, part.low, part.high, limit) >= 0.0;
}

// The nearest triangle before limit, in units of the direction's length.
Hit nearest_hit(vec3 origin, vec3 direction, float limit) {
    Hit best = Hit(-1, 0.0, 0.0, limit);
    for (uint i = 0u; i < bvh_part_count.x; i++) {
        Part part = bvh_parts[i];
        if (!bvh_near(part, origin, direction, best.distance)) continue;
        BvhRay ray = bvh_ray(part, origin, direction);
        if (bvh_near_box(ray, part, best.distance)) bvh_walk(ray, part.root, best, false);
    }
    return best;
}

// The kind of the first part, in their order, that is hit before limit; 0: none.
uint blocked(vec3 origin, vec3 direction, float limit) {
    Hit best = Hit(-1, 0.0, 0.0, limit);
    for (uint i = 0u; i < bvh_part_count.x; i++) {
        Part part = bvh_parts[i];
        if (!bvh_near(part, origin, direction, limit)) continue;
        BvhRay ray = bvh_ray(part, origin, direction);
        if (bvh_near_box(ray, part, limit) && bvh_walk(ray, part.root, best, true)) return part.kind;
    }
    return 0u;
}
