#version 330 core
// SPDX-License-Identifier: GPL-3.0-or-later
// Pass "place": vertices of one object from its own space into the frame's local space. Run once for an object that
// moved; its output is written to a buffer, nothing is drawn.
#if defined VERTEX_SHADER

in vec3 in_position; // object space, about the middle of the mesh

uniform vec4 row_x; // object to local
uniform vec4 row_y;
uniform vec4 row_z;

out vec3 out_position; // local space, m

void main()
{
    vec4 p = vec4(in_position, 1.0);
    out_position = vec3(dot(row_x, p), dot(row_y, p), dot(row_z, p));
}

#endif
