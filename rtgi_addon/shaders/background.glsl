#version 330 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "background": clears the tiles of some texels, in colour and depth, to the sky behind everything: the entry of
// the patch that a pixel looks at, or `escaped` where the sky has one colour or there is none.
#if defined VERTEX_SHADER

in vec3 in_tangent;
in vec3 in_normal;
in vec2 in_tile; // left and bottom of its view in the target, pixels

uniform vec2 size;   // of a view, pixels
uniform vec2 target; // width and height of the target, pixels

flat out vec3 tangent;
flat out vec3 normal;
flat out vec2 tile;

void main()
{
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    gl_Position = vec4(2.0 * (in_tile + corner * size) / target - 1.0, 1.0, 1.0);
    tangent = in_tangent;
    normal = in_normal;
    tile = in_tile;
}

#elif defined FRAGMENT_SHADER

#include "inc/sky.glsl"

flat in vec3 tangent;
flat in vec3 normal;
flat in vec2 tile;

uniform sampler2D directions; // of each pixel of a view, tangent space

layout(location = 0) out uint entry;

void main()
{
    vec3 way = texelFetch(directions, ivec2(gl_FragCoord.xy - tile), 0).xyz;
    entry = sky_entry(way.x * tangent + way.y * cross(normal, tangent) + way.z * normal);
}

#endif
