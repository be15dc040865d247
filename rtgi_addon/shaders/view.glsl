#version 330 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "view": the scene as many texels see it (Larsen04 §4), one face of their views in one draw, an instance a texel.
// Each texel has a tile of the target; four clip distances keep a triangle within it. A pixel is not a colour but where
// to look one up: the atlas pixel that is seen, or `none` on a side without a map.
//
// There is no near plane: depth is written by the fragment, as the logarithm of the distance, and nothing is clipped
// along the way. What touches the texel is drawn as well as what is a kilometre away.

#ifndef TWO_SIDED
#error Required define TWO_SIDED, 0 or 1: has any back side a map?
#endif
#ifndef PARTED
#error Required define PARTED, 0 or 1: are only every so many pixels drawn, from a point of their own?
#endif
#if TWO_SIDED
#define PIXEL vec4 // column and row on the atlas page: of the front side, of the back side
#define FIRST ivec2
#else
#define PIXEL vec2
#define FIRST int
#endif
#if defined VERTEX_SHADER

in vec3 in_position; // local space
in PIXEL in_pixel;
in FIRST in_first; // number of the page's first pixel for each side; -1: that side has no map

// of the texel
in vec3 in_eye;
in vec3 in_tangent;
in vec3 in_normal;
in vec2 in_tile; // left and bottom of its view in the target, pixels

uniform mat3 axes;      // tangent space to right, up and forward of the face; see views.Face
uniform float low;      // lowest y that is drawn, in units of forward
uniform vec4 rectangle; // left, bottom, width, height of the face within a view, pixels
uniform vec2 target;    // width and height of the target, pixels

out PIXEL pixel;
flat out FIRST first;
out float gl_ClipDistance[4];

void main()
{
    vec3 away = in_position - in_eye;
    vec3 p = axes * vec3(dot(away, in_tangent), dot(away, cross(in_normal, in_tangent)), dot(away, in_normal));
    gl_ClipDistance[0] = p.z + p.x;
    gl_ClipDistance[1] = p.z - p.x;
    gl_ClipDistance[2] = p.y - low * p.z;
    gl_ClipDistance[3] = p.z - p.y;
    vec2 half_size = rectangle.zw / target;
    vec2 middle = (2.0 * (in_tile + rectangle.xy) + rectangle.zw) / target - 1.0;
    float y = (2.0 * p.y - (1.0 + low) * p.z) / (1.0 - low);
    gl_Position = vec4(middle * p.z + half_size * vec2(p.x, y), 0.0, p.z);
    pixel = in_pixel;
    first = in_first;
}

#elif defined FRAGMENT_SHADER

in PIXEL pixel;
flat in FIRST first;

uniform int resolution;    // of an atlas page
uniform uint none;         // the entry of what has no light
uniform int part;          // which pixel of each 2 × 2
uniform vec2 depth;        // of 1 m, and what each octave of distance adds

layout(location = 0) out uint entry;

void main()
{
#if PARTED
    ivec2 odd = ivec2(gl_FragCoord.xy) & 1;
    if (odd.x + 2 * odd.y != part)
        discard;
#endif
#if TWO_SIDED
    vec2 at = gl_FrontFacing ? pixel.xy : pixel.zw;
    int page = gl_FrontFacing ? first.x : first.y;
#else
    vec2 at = pixel;
    int page = gl_FrontFacing ? first : -1;
#endif
    ivec2 cell = clamp(ivec2(at), 0, resolution - 1);
    entry = page < 0 ? none : uint(page + cell.y * resolution + cell.x);
    gl_FragDepth = depth.x - depth.y * log2(gl_FragCoord.w);
}

#endif
