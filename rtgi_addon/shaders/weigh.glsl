#version 330 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "weigh": every pixel times its weight, times the pixels of a view, as Larsen04 §4 does before it lets the mip-map
// hardware take the mean. For comparison with pass "sum", which rounds less and keeps halves apart.
#ifndef VIEW_WIDTH
#error Required define VIEW_WIDTH, for example 64: pixels across a view, a multiple of four
#endif
#ifndef VIEW_HEIGHT
#error Required define VIEW_HEIGHT, for example 192: pixels up a view
#endif
#if defined VERTEX_SHADER

#include "inc/whole_target.glsl"

#elif defined FRAGMENT_SHADER

#include "inc/table.glsl"
#include "inc/weights.glsl"

uniform usampler2D entries; // what each pixel sees
uniform sampler2D sent;     // radiosity of each entry, W/m²; red below LEAST_SENT where it does not count

layout(location = 0) out vec4 weighed;

void main()
{
    ivec2 at = ivec2(gl_FragCoord.xy);
    ivec2 within = at % ivec2(VIEW_WIDTH, VIEW_HEIGHT);
    vec3 brought = table_entry(sent, texelFetch(entries, at, 0).x).rgb;
    float weight = weights_at(within.x & ~3, within.y)[within.x & 3] * float(VIEW_WIDTH * VIEW_WIDTH);
    weighed = brought.r < LEAST_SENT ? vec4(0.0) : vec4(brought, 1.0) * weight;
}

#endif
