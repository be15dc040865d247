#version 330 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "sum": one fragment a view adds up what its pixels bring, in order: Larsen04's equation 3, each half of the
// pixels by itself. The alpha of both is the weight of the pixels that count: those that see what has a light of its
// own, and lie above the texel's own triangle.
#ifndef VIEW_WIDTH
#error Required define VIEW_WIDTH, for example 64: pixels across a view
#endif
#ifndef VIEW_HEIGHT
#error Required define VIEW_HEIGHT, for example 192: pixels up a view
#endif
#ifndef TILTED
#error Required define TILTED, 0 or 1: does any texel's normal differ from its triangle's?
#endif
#if defined VERTEX_SHADER

#include "inc/whole_target.glsl"

#elif defined FRAGMENT_SHADER

#include "inc/table.glsl"

uniform usampler2D entries; // what each pixel sees
uniform sampler2D view;     // direction, tangent space, and weight of each pixel of a view
uniform sampler2D sent;     // radiosity of each entry, W/m²; alpha 1 where it counts, else 0
uniform sampler2D triangle; // of each view: the normal of the texel's own triangle, tangent space

layout(location = 0) out vec4 first;
layout(location = 1) out vec4 second;

void main()
{
    ivec2 tile = ivec2(gl_FragCoord.xy);
    ivec2 corner = tile * ivec2(VIEW_WIDTH, VIEW_HEIGHT);
#if TILTED
    vec3 up = texelFetch(triangle, tile, 0).xyz;
#endif
    vec4 total[2] = vec4[2](vec4(0.0), vec4(0.0));
    for (int y = 0; y < VIEW_HEIGHT; ++y) {
        // Sums of rows first: a view of 64 × 192 pixels loses no digit to its length.
        vec4 row[2] = vec4[2](vec4(0.0), vec4(0.0));
        for (int x = 0; x < VIEW_WIDTH; ++x) {
            vec4 pixel = texelFetch(view, ivec2(x, y), 0);
#if TILTED
            if (dot(pixel.xyz, up) <= 0.0)
                continue;
#endif
            vec4 brought = table_entry(sent, texelFetch(entries, corner + ivec2(x, y), 0).x);
            row[(x + y) & 1] += pixel.w * brought;
        }
        total[0] += row[0];
        total[1] += row[1];
    }
    first = total[0];
    second = total[1];
}

#endif
