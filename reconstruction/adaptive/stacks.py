"""Stacks of like blocks: their distances, cosines within a block, Walsh-Hadamard across a stack.

A block is SIDE x SIDE numbers, a quarter of it is a cell. A stack of up to STACK blocks side by
side is an array (row, block column), as wide as STACK blocks, of which `width` numbers are used.

Kernels cut slices and count from 0 within them: only where no index can be negative does the
compiler make vectors of a loop. Written in vector instructions by hand these loops take half the
time, which is a tenth of a reconstruction's (96x128, one shot, one thread).
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dct

from emmc_rig.model.compiling import njit

SIDE = 8
CELL = SIDE // 2
STACK = 16
"""A power of two."""
COSINES = np.asarray(dct(np.eye(SIDE), axis=0, norm="ortho"), dtype=np.float32)
"""The matrix C of the orthonormal cosine transform, a frequency a row; its inverse is C^T."""
INVERSE = np.ascontiguousarray(COSINES.T)


@njit(forceinline=True, fastmath=True)
def cells_apart(guide, y, x, reach, squares):
    """Set squares (row, column) to the squared distances of a picture's cells from one of its own.

    y, x: where the cell begins in the picture without the margin of `reach` that guide (y, x) has.
    The other cells are displaced by -reach to reach rows and columns.
    """
    cell = guide[y + reach : y + reach + CELL, x + reach : x + reach + CELL]
    for row in range(CELL):
        p, q, r, s = cell[row, 0], cell[row, 1], cell[row, 2], cell[row, 3]
        for down in range(2 * reach + 1):
            out, other = squares[down], guide[y + down + row, x:]
            for n in range(out.size):
                a, b, c, d = other[n] - p, other[n + 1] - q, other[n + 2] - r, other[n + 3] - s
                square = a * a + b * b + c * c + d * d
                out[n] = square if row == 0 else out[n] + square


@njit(forceinline=True, fastmath=True)
def _multiply(matrix, stack, out, width):
    """Set out to matrix @ stack: each block B of the stack becomes matrix @ B."""
    a, b, c, d, e, f, g, h = (
        stack[0], stack[1], stack[2], stack[3], stack[4], stack[5], stack[6], stack[7]
    )  # fmt: skip
    for row in range(SIDE):
        m, line = matrix[row], out[row]
        for n in range(width):
            line[n] = (
                m[0] * a[n] + m[1] * b[n] + m[2] * c[n] + m[3] * d[n]
                + m[4] * e[n] + m[5] * f[n] + m[6] * g[n] + m[7] * h[n]
            )  # fmt: skip


@njit(forceinline=True, fastmath=True)
def transform(matrix, stack, out, width):
    """Set out to (matrix B matrix^T)^T for each block B of a stack, which is overwritten.

    By COSINES B becomes the transpose K of its coefficients, by INVERSE K becomes B again.
    """
    _multiply(matrix, stack, out, width)
    for row in range(SIDE):
        for column in range(SIDE):
            source, target = out[row, column:], stack[column, row:]
            for block in range(0, width, SIDE):
                target[block] = source[block]
    _multiply(matrix, stack, out, width)


@njit(forceinline=True, fastmath=True)
def _across(stack, width):
    """Replace a stack by its Walsh-Hadamard transform across the blocks, not normalised.

    Two steps of it at a time, which halves the passes over the stack, then a last one.
    """
    part = width // 4
    while part >= SIDE:
        for first in range(0, width, 4 * part):
            for row in range(SIDE):
                line = stack[row, first : first + 4 * part]
                p, q, r, s = line[:part], line[part:], line[2 * part :], line[3 * part :]
                for n in range(p.size):
                    a, b, c, d = p[n] + r[n], q[n] + s[n], p[n] - r[n], q[n] - s[n]
                    p[n], q[n], r[n], s[n] = a + b, a - b, c + d, c - d
        part //= 4
    if part == SIDE // 2:
        for row in range(SIDE):
            for first in range(0, width, 2 * SIDE):
                p, q = stack[row, first : first + SIDE], stack[row, first + SIDE :]
                for n in range(SIDE):
                    p[n], q[n] = p[n] + q[n], p[n] - q[n]


@njit(forceinline=True, fastmath=True)
def shrink_stack(stack, width, least):
    """Drop coefficients nearer zero than `least` across a stack; return how many are kept.

    With H the Walsh-Hadamard matrix of n blocks, H H = n: the coefficients H stack / sqrt(n) are
    compared with `least`, and the stack becomes H (kept), n times what is left of it. n is a power
    of two. The stack's mean (0, 0) stays, and counts where it is not nearer zero.
    """
    _across(stack, width)
    cut = least * np.float32(np.sqrt(width // SIDE))
    kept, mean = np.int32(0), stack[0, 0]
    for row in range(SIDE):
        line = stack[row, :width]
        for n in range(line.size):
            stays = abs(line[n]) >= cut
            kept += np.int32(stays)
            line[n] = line[n] if stays else np.float32(0)
    stack[0, 0] = mean
    _across(stack, width)
    return kept
