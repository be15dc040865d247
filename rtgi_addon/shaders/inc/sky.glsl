// SPDX-License-Identifier: GPL-3.0-or-later
// Which patch of the sky a direction looks at; must match Sky.of_directions in backend/lamps/sky.py.
uniform uvec2 sky_size;  // rows and columns of patches; 0 where there is no sky
uniform uint sky_first;  // the entry of the first patch
uniform uint escaped;    // the entry of nothing at all

const float SKY_PI = 3.14159265358979;

uint sky_entry(vec3 way)
{
    if (sky_size.x * sky_size.y < 2u)
        return sky_size.x == 0u ? escaped : sky_first;
    float u = 0.5 - atan(way.y, way.x) / (2.0 * SKY_PI);
    float v = 0.5 + asin(clamp(way.z, -1.0, 1.0)) / SKY_PI;
    uint column = min(uint(max(u * float(sky_size.y), 0.0)), sky_size.y - 1u);
    uint row = min(uint(max(v * float(sky_size.x), 0.0)), sky_size.x - 1u);
    return sky_first + row * sky_size.y + column;
}
