// SPDX-License-Identifier: GPL-3.0-or-later
// Long arrays in textures. TABLE_WIDTH must match backend/gpu/tables.py.
const uint TABLE_WIDTH = 4096u;

vec4 table_entry(sampler2D table, uint index)
{
    return texelFetch(table, ivec2(index % TABLE_WIDTH, index / TABLE_WIDTH), 0);
}
