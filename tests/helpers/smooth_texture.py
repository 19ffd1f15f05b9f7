"""A texture that is known as a function, and a dark one, for worlds of the ray caster."""

import numpy as np

SIDE = 256
UNLIT = np.zeros((SIDE, SIDE, 4), np.float32)

_q, _p = (np.indices((SIDE, SIDE)) + 0.5) / SIDE
SMOOTH = np.stack(
    [
        0.5 + 0.3 * np.sin(2 * np.pi * 2 * _p) * np.cos(2 * np.pi * _q),
        0.5 + 0.3 * np.cos(2 * np.pi * (_p + 2 * _q)),
        0.5 + 0.3 * np.sin(2 * np.pi * (2 * _p - _q)),
        np.ones_like(_p),
    ],
    axis=-1,
).astype(np.float32)
