#version 330 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "weigh": every pixel times its weight, times the pixels of a view, as Larsen04 §4 does before it lets the mip-map
// hardware take the mean. For comparison with pass "sum", which rounds less and keeps halves apart.
#ifndef VIEW_WIDTH
#error Required define VIEW_WIDTH, for example 64: pixels across a view
#endif
#ifndef VIEW_HEIGHT
#error Required define VIEW_HEIGHT, for example 192: pixels up a view
#endif
#if defined VERTEX_SHADER

#include "inc/whole_target.glsl"

#elif defined FRAGMENT_SHADER

#include "inc/table.glsl"

uniform usampler2D entries; // what each pixel sees
uniform sampler2D view;     // direction, tangent space, and weight of each pixel of a view
uniform sampler2D sent;     // radiosity of each entry, W/m²; alpha 1 where it counts, else 0

layout(location = 0) out vec4 weighed;

void main()
{
    ivec2 at = ivec2(gl_FragCoord.xy);
    float weight = texelFetch(view, at % ivec2(VIEW_WIDTH, VIEW_HEIGHT), 0).w;
    weighed = table_entry(sent, texelFetch(entries, at, 0).x) * (weight * float(VIEW_WIDTH * VIEW_WIDTH));
}

#endif
