"""Descriptors in seven bits a value: what a feature store keeps of rows of real numbers.

A row is scaled by its largest absolute value and rounded to 127 equally spaced values in [-1, 1]. Each code has seven
bits; a byte holds one code, and in its eighth bit one bit of a further code, so that eight codes take seven bytes:
with G = ceil(D / 8), bytes 0 to 7G - 1 hold codes 0 to 7G - 1, and the top bits of bytes g, G + g, ..., 6G + g are
code 7G + g, lowest bit first. The step of a descriptor of 128 values is about 1/33 of the values' standard
deviation; the cosine between a row and what is read back of it is 1 - 1e-4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BITS = 7
_TOP = 2 ** (BITS - 1) - 1  # codes -63 to 63
_LOW = np.uint8(2**BITS - 1)
_CHUNK = 512  # rows unpacked at once: what is in between stays in the processor's cache


def pack_rows(rows: NDArray[np.floating]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Rows (N, D) as bytes (N, 7 ceil(D / 8)) and a factor (N,) that restores each row's length.

    Raises ValueError for rows that are not finite.
    """
    values = np.asarray(rows, np.float32)
    if not np.isfinite(values).all():
        raise ValueError("descriptors with values that are not finite cannot be stored")
    largest = np.abs(values).max(axis=1, initial=0.0, keepdims=True)
    codes = np.rint(_TOP * np.divide(values, largest, out=np.zeros_like(values), where=largest > 0))
    lengths = np.linalg.norm(values, axis=1), np.linalg.norm(codes, axis=1)
    factors = np.divide(*lengths, out=np.zeros(len(values), np.float32), where=lengths[1] > 0)
    return _pack(codes), factors


def unpack_rows(
    packed: NDArray[np.uint8], factors: NDArray[np.floating], size: int, dtype: np.dtype
) -> NDArray[np.float16] | NDArray[np.float32]:
    """The rows (N, size) that `pack_rows` was given, as `dtype`, each of the length that its factor says."""
    rows = np.empty((len(packed), size), dtype)
    for start in range(0, len(packed), _CHUNK):
        part = slice(start, start + _CHUNK)
        codes = _unpack(packed[part])[:, :size]
        np.multiply(codes, factors[part, None].astype(np.float32), out=rows[part], casting="same_kind")
    return rows


def _groups(size: int) -> int:
    return -(-size // 8)


def _pack(codes: NDArray[np.float32]) -> NDArray[np.uint8]:
    count, size = codes.shape
    groups = _groups(size)
    unsigned = np.zeros((count, 8, groups), np.uint8)
    unsigned.reshape(count, 8 * groups)[:, :size] = codes + (_TOP + 1)
    packed, last = unsigned[:, :BITS], unsigned[:, BITS]
    for bit in range(BITS):
        packed[:, bit] |= ((last >> bit) & 1) << BITS
    return np.ascontiguousarray(packed.reshape(count, BITS * groups))  # the view has gaps


def _unpack(packed: NDArray[np.uint8]) -> NDArray[np.int8]:
    count, width = packed.shape
    codes = np.empty((count, 8, width // BITS), np.uint8)
    bytes_ = packed.reshape(count, BITS, width // BITS)
    np.bitwise_and(bytes_, _LOW, out=codes[:, :BITS])
    last = codes[:, BITS]
    last[:] = bytes_[:, 0] >> BITS
    for bit in range(1, BITS):
        last |= (bytes_[:, bit] >> BITS) << bit
    return codes.reshape(count, 8 * (width // BITS)).view(np.int8) - np.int8(_TOP + 1)
