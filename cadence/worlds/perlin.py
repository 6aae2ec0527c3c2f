"""Gradient noise on a plane: Perlin's improved noise in two dimensions, summed over octaves.

Source: K. Perlin, "Improving noise" (SIGGRAPH 2002), with its reference permutation. The arithmetic is in float32, as in
the common C implementations: a terrain made from it is compared with theirs cell by cell.
"""

import numpy as np

from cadence.arrays import Float32s, Float64s, Int64s

_PERMUTATION = """
151 160 137 91 90 15 131 13 201 95 96 53 194 233 7 225 140 36 103 30 69 142 8 99 37 240 21 10 23 190 6 148 247 120 234 75 0
26 197 62 94 252 219 203 117 35 11 32 57 177 33 88 237 149 56 87 174 20 125 136 171 168 68 175 74 165 71 134 139 48 27 166
77 146 158 231 83 111 229 122 60 211 133 230 220 105 92 41 55 46 245 40 244 102 143 54 65 25 63 161 1 216 80 73 209 76 132
187 208 89 18 169 200 196 135 130 116 188 159 86 164 100 109 198 173 186 3 64 52 217 226 250 124 123 5 202 38 147 118 126
255 82 85 212 207 206 59 227 47 16 58 17 182 189 28 42 223 183 170 213 119 248 152 2 44 154 163 70 221 153 101 155 167 43
172 9 129 22 39 253 19 98 108 110 79 113 224 232 178 185 112 104 218 246 97 228 251 34 242 193 238 210 144 12 191 179 162
241 81 51 145 235 249 14 239 107 49 192 214 31 181 199 106 157 184 84 204 176 115 121 50 45 127 4 150 254 138 236 205 93
222 114 67 29 24 72 243 141 128 195 78 66 215 61 156 180
"""
_TABLE = np.tile(np.array(_PERMUTATION.split(), dtype=np.int64), 3)
# The gradients of the noise in three dimensions, cut to the plane: twelve edges of a cube, four of them twice.
_GRADIENTS = np.array(
    "1 1  -1 1  1 -1  -1 -1  1 0  -1 0  1 0  -1 0  0 1  0 -1  0 1  0 -1  1 0  -1 0  0 -1  0 1".split(), dtype=np.float32
).reshape(16, 2)


def octave(x: Float32s, y: Float32s, period: np.float32, base: int) -> Float32s:
    """One octave [X, Y] of noise in about -1 ... 1 at the products of `x` [X] and `y` [Y], repeating after `period`.

    `base` shifts the lattice: other numbers give other landscapes.
    """
    column, next_column, across, blend_x = _axis(x, period, base)
    row, next_row, along, blend_y = _axis(y, period, base)
    u, v = across[:, None], along[None, :]
    corners = []
    for i, j, du, dv in (
        (column, row, 0, 0),
        (next_column, row, 1, 0),
        (column, next_row, 0, 1),
        (next_column, next_row, 1, 1),
    ):
        gradient = _GRADIENTS[_TABLE[_TABLE[_TABLE[i][:, None] + j[None, :]]] & 15]
        corners.append((u - np.float32(du)) * gradient[..., 0] + (v - np.float32(dv)) * gradient[..., 1])
    low = corners[0] + blend_x[:, None] * (corners[1] - corners[0])
    high = corners[2] + blend_x[:, None] * (corners[3] - corners[2])
    noise: Float32s = low + blend_y[None, :] * (high - low)
    return noise


def fractal(
    x: Float32s, y: Float32s, *, octaves: int, persistence: float, lacunarity: float, period: float, base: int
) -> Float32s:
    """Octaves summed: each has `persistence` times the height and `lacunarity` times the frequency of the one before.

    Returns [X, Y] for `x` [X] and `y` [Y], divided by the sum of the heights.
    """
    frequency, height, heights = np.float32(1.0), np.float32(1.0), np.float32(0.0)
    total = np.zeros((len(x), len(y)), dtype=np.float32)
    for _ in range(octaves):
        total += octave(x * frequency, y * frequency, np.float32(period) * frequency, base) * height
        heights += height
        frequency *= np.float32(lacunarity)
        height *= np.float32(persistence)
    return total / heights


def enlarge_twice(image: Float64s) -> Float64s:
    """The image [X, Y] at twice the resolution [2X, 2Y], bilinear between the middles of its cells, flat beyond the last."""
    for axis in (1, 0):
        image = np.swapaxes(image, 0, axis)
        padded = np.concatenate([image[:1], image, image[-1:]])
        finer = np.empty((2 * len(image), image.shape[1]))
        rise = np.diff(padded, axis=0)
        finer[0::2] = padded[:-2] + rise[:-1] * 0.75
        finer[1::2] = padded[1:-1] + rise[1:] * 0.25
        image = np.swapaxes(finer, 0, axis)
    return image


def _axis(x: Float32s, period: np.float32, base: int) -> tuple[Int64s, Int64s, Float32s, Float32s]:
    """Lattice line below, the one above, place between them and its smooth blend, of coordinates `x` [X]."""
    cell = np.floor(np.fmod(x, period)).astype(np.int64)
    above = np.fmod(cell + 1, period).astype(np.int64)
    place: Float32s = (x - np.floor(x)).astype(np.float32)
    six, fifteen, ten = np.float32(6), np.float32(15), np.float32(10)
    blend = place * place * place * (place * (place * six - fifteen) + ten)
    return (cell & 255) + base, (above & 255) + base, place, blend.astype(np.float32)
