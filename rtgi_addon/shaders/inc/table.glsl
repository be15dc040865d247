// SPDX-License-Identifier: GPL-3.0-or-later
// Long arrays in textures. TABLE_WIDTH must match backend/gpu/tables.py.
const uint TABLE_WIDTH = 4096u;

vec4 table_entry(sampler2D table, uint index)
{
    return texelFetch(table, ivec2(index % TABLE_WIDTH, index / TABLE_WIDTH), 0);
}

// Entries with less red do not count; see DOES_NOT_COUNT in backend/final_gather/views/entries.py.
const float LEAST_SENT = -1e38;
