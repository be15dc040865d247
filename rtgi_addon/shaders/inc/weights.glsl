// SPDX-License-Identifier: GPL-3.0-or-later
// Weights of a view's pixels, four in a row at a time: from a uniform block, which is read fastest, or from a texture
// where they are more than a block may hold.
#ifndef WEIGHTS_IN_BLOCK
#error Required define WEIGHTS_IN_BLOCK, 0 or 1
#endif
#if WEIGHTS_IN_BLOCK
layout(std140) uniform Weights { vec4 weights[VIEW_WIDTH * VIEW_HEIGHT / 4]; };
#else
uniform sampler2D weights; // VIEW_WIDTH / 4 across
#endif

// Of the pixels x .. x + 3 of row y; x is a multiple of four.
vec4 weights_at(int x, int y)
{
#if WEIGHTS_IN_BLOCK
    return weights[(y * VIEW_WIDTH + x) / 4];
#else
    return texelFetch(weights, ivec2(x / 4, y), 0);
#endif
}
