#version 430 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "sum_groups": what pass "sum" does, by a group of invocations a view: each adds up a column of pixels, and the
// columns are added in pairs. For devices that compute faster than they draw.
#ifndef VIEW_WIDTH
#error Required define VIEW_WIDTH, for example 64: pixels across a view, a multiple of four
#endif
#ifndef VIEW_HEIGHT
#error Required define VIEW_HEIGHT, for example 192: pixels up a view, even
#endif
#ifndef TILTED
#error Required define TILTED, 0 or 1: does any texel's normal differ from its triangle's?
#endif
#ifndef SUMS
#error Required define SUMS: the binding of the sums, e.g. 0
#endif

#include "inc/table.glsl"
#include "inc/weights.glsl"

#define GROUP 64

layout(local_size_x = GROUP) in;

uniform int across;           // tiles of the target
uniform usampler2D entries;   // what each pixel sees
uniform sampler2D sent;       // radiosity of each entry, W/m²; red below LEAST_SENT where it does not count
uniform sampler2D directions; // of each pixel of a view, tangent space
uniform sampler2D triangle;   // of each view: the normal of the texel's own triangle, tangent space

layout(std430, binding = SUMS) writeonly buffer Sums { vec4 sums[]; }; // both halves of each tile

shared vec4 column_sums[2][GROUP];

void main()
{
    int number = int(gl_WorkGroupID.x), column = int(gl_LocalInvocationID.x);
    ivec2 tile = ivec2(number % across, number / across);
    ivec2 corner = tile * ivec2(VIEW_WIDTH, VIEW_HEIGHT);
#if TILTED
    vec3 up = texelFetch(triangle, tile, 0).xyz;
#endif
    vec4 total[2] = vec4[2](vec4(0.0), vec4(0.0));
    for (int x = column; x < VIEW_WIDTH; x += GROUP) {
        for (int y = 0; y < VIEW_HEIGHT; ++y) {
            vec3 brought = table_entry(sent, texelFetch(entries, corner + ivec2(x, y), 0).x).rgb;
            vec4 counted = weights_at(x & ~3, y)[x & 3] * vec4(brought, 1.0);
            bool counts = brought.r >= LEAST_SENT;
#if TILTED
            counts = counts && dot(texelFetch(directions, ivec2(x, y), 0).xyz, up) > 0.0;
#endif
            total[((x ^ y) >> 1) & 1] += counts ? counted : vec4(0.0);
        }
    }
    column_sums[0][column] = total[0];
    column_sums[1][column] = total[1];
    for (int step = GROUP / 2; step > 0; step /= 2) {
        barrier();
        if (column < step) {
            column_sums[0][column] += column_sums[0][column + step];
            column_sums[1][column] += column_sums[1][column + step];
        }
    }
    if (column == 0) {
        sums[2 * number] = column_sums[0][0];
        sums[2 * number + 1] = column_sums[1][0];
    }
}
