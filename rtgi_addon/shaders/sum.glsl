#version 330 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "sum": one fragment a view adds up what its pixels bring, in order: Larsen04's equation 3, each half of the
// pixels by itself, fields of a chessboard of 2 × 2 pixels, so that each holds all parts of a parted view. The alpha of
// both is the weight of the pixels that count: those that see what has a light of its own, and lie above the texel's
// own triangle.
#ifndef VIEW_WIDTH
#error Required define VIEW_WIDTH, for example 64: pixels across a view, a multiple of four
#endif
#ifndef VIEW_HEIGHT
#error Required define VIEW_HEIGHT, for example 192: pixels up a view, even
#endif
#ifndef TILTED
#error Required define TILTED, 0 or 1: does any texel's normal differ from its triangle's?
#endif
#if defined VERTEX_SHADER

#include "inc/whole_target.glsl"

#elif defined FRAGMENT_SHADER

#include "inc/table.glsl"
#include "inc/weights.glsl"

uniform usampler2D entries;   // what each pixel sees
uniform sampler2D sent;       // radiosity of each entry, W/m²; red below LEAST_SENT where it does not count
uniform sampler2D directions; // of each pixel of a view, tangent space
uniform sampler2D triangle;   // of each view: the normal of the texel's own triangle, tangent space

layout(location = 0) out vec4 first;
layout(location = 1) out vec4 second;

void main()
{
    ivec2 tile = ivec2(gl_FragCoord.xy);
    ivec2 corner = tile * ivec2(VIEW_WIDTH, VIEW_HEIGHT);
#if TILTED
    vec3 up = texelFetch(triangle, tile, 0).xyz;
#endif
    // Sums of rows first: a view of 64 × 192 pixels loses no digit to its length.
    vec4 total[2] = vec4[2](vec4(0.0), vec4(0.0));
    for (int y = 0; y < VIEW_HEIGHT; ++y) {
        vec4 even = vec4(0.0), odd = vec4(0.0); // by pair of columns
        for (int x = 0; x < VIEW_WIDTH; x += 4) {
            vec4 weight = weights_at(x, y);
            for (int k = 0; k < 4; ++k) {
                vec3 brought = table_entry(sent, texelFetch(entries, corner + ivec2(x + k, y), 0).x).rgb;
                vec4 counted = brought.r < LEAST_SENT ? vec4(0.0) : weight[k] * vec4(brought, 1.0);
#if TILTED
                counted = dot(texelFetch(directions, ivec2(x + k, y), 0).xyz, up) > 0.0 ? counted : vec4(0.0);
#endif
                if (k < 2)
                    even += counted;
                else
                    odd += counted;
            }
        }
        total[0] += (y & 2) == 0 ? even : odd;
        total[1] += (y & 2) == 0 ? odd : even;
    }
    first = total[0];
    second = total[1];
}

#endif
