# SPDX-License-Identifier: GPL-3.0-or-later
"""Pages of light maps as small pictures for a report: shrunk, exposed alike, and packed as PNG into data URIs.

Row 0 of every array is the bottom row, as in the maps; only PNG turns it round. No bpy here.
"""

from __future__ import annotations

import base64
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from .backend.scene import Bool, Float32, Float64

#: Longest side of a picture, px.
SIDE = 256
#: Rec. 709 luminance of linear RGB, the maps' own primaries.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
#: The irradiance that EXPOSED of the texels stay below is shown at this share of white.
EXPOSED, SHOWN = 0.95, 0.5
#: Colours of change, sRGB: less light, none, more light.
LESS, SAME, MORE = (np.array(c, np.float32) for c in ((38, 110, 220), (128, 128, 128), (240, 120, 20)))
#: How opaque an unchanged texel is: it shows the map's outline on any background, and no more.
SAME_OPACITY = 0.25


@dataclass(frozen=True)
class Small:
    """A page, or a change of a page, shrunk for looking at."""

    values: Float32  # (h, w, channels), means over the valid texels of a block
    valid: Bool  # (h, w), some texel of the block is valid


def shrink(values: Float32, valid: Bool) -> Small:
    """Block means of ``values`` (H, W, channels) over ``valid`` (H, W), at most SIDE pixels a side."""
    height, width, channels = values.shape
    factor = block_side(height, width)
    rows, columns = -(-height // factor), -(-width // factor)
    padded = np.zeros((rows * factor, columns * factor, channels + 1), np.float32)
    padded[:height, :width, :channels] = np.where(valid[..., None], values, 0)
    padded[:height, :width, channels] = valid
    sums = padded.reshape(rows, factor, columns, factor, channels + 1).sum(axis=(1, 3))
    return Small(sums[..., :channels] / np.maximum(sums[..., channels:], 1), sums[..., channels] > 0)


def block_side(height: int, width: int) -> int:
    """Texels a side of one pixel of the picture."""
    return -(-max(height, width) // SIDE)


def luminance(rgb: Float32) -> Float32:
    """(..., 1) from linear (..., 3)."""
    return (rgb * LUMINANCE).sum(axis=-1, keepdims=True, dtype=np.float32)


def exposure(pictures: list[Small]) -> float:
    """Per W/m²: how much to expose all ``pictures``, so that EXPOSED of their texels keep below SHOWN; 0 if black."""
    lit = np.concatenate([luminance(p.values[p.valid]).ravel() for p in pictures] or [np.zeros(0, np.float32)])
    lit = lit[lit > 0]
    return float(-np.log1p(-SHOWN) / np.quantile(lit, EXPOSED)) if lit.size else 0.0


def develop(irradiance: Float32 | Float64, exposed: float) -> Float32:
    """sRGB in [0, 1]: 1 - exp(-exposure E), which is linear in the dark and never clips."""
    light = -np.expm1(-np.maximum(irradiance, 0) * exposed)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055).astype(np.float32)


def largest_change(changes: list[Small]) -> float:
    """W/m² of luminance at the end of the colour scale: 99 % of the texels that changed lie within; 0 if none did."""
    moved = np.concatenate([np.abs(c.values[c.valid]).ravel() for c in changes] or [np.zeros(0, np.float32)])
    moved = moved[moved > 0]
    return float(np.quantile(moved, 0.99)) if moved.size else 0.0


def change_colours(change: Float32 | Float64, scale: float) -> Float32:
    """sRGB and opacity (..., 4) in [0, 1] of luminance changes (..., 1) in W/m²; the ends mean ``scale`` or more.

    Colour grows as the square root, so that bounced light far from what moved is seen beside what is near it.
    """
    amount = np.sqrt(np.clip(np.abs(change) / scale, 0, 1)) if scale else np.zeros_like(change)
    colour = SAME + (np.where(change > 0, MORE, LESS) - SAME) * amount
    return np.concatenate([colour / 255, SAME_OPACITY + (1 - SAME_OPACITY) * amount], axis=-1).astype(np.float32)


def map_uri(small: Small, exposed: float) -> str:
    """``small`` (RGB irradiance) as a picture, clear where no texel is."""
    return _uri(np.concatenate([develop(small.values, exposed), small.valid[..., None]], axis=-1))


def change_uri(small: Small, scale: float) -> str:
    """``small`` (change of luminance) as a picture."""
    return _uri(change_colours(small.values, scale) * small.valid[..., None])


def _uri(rgba: Float32) -> str:
    """``rgba`` (h, w, 4) in [0, 1] as a data URI."""
    return "data:image/png;base64," + base64.b64encode(png(np.rint(rgba * 255).astype(np.uint8))).decode("ascii")


def png(rgba: np.ndarray) -> bytes:
    """A PNG file (ISO/IEC 15948) of ``rgba`` (h, w, 4) uint8, each row less the one below: smaller than plain rows."""
    height, width, _ = rgba.shape
    rows = rgba[::-1].reshape(height, -1)
    filtered = np.full((height, 1 + rows.shape[1]), 2, np.uint8)  # filter type 2, "up", on every row
    filtered[:, 1:] = np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)  # 8 bits, RGBA
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
