"""Figures of peers that are too slow to run with the report, or whose installation is no one-liner.

Measured separately, on the same kind of machine (two noisy cores, one thread), by the authors of this report: nothing
here is copied from what others printed. To be set beside times of another run with care: ratios within a column hold.
"""

from __future__ import annotations

# Cubes at rest on a plane, dt 0.01, milliseconds per step: forward, then backward or what stands in for it.
TIMES = {
    "columns": ("peer", "gradient by", "cubes", "forward [ms]", "backward [ms]"),
    "rows": (
        ("MuJoCo 4.0.0", "centred differences (mjd_transitionFD)", 20, 0.030, 23),
        ("MuJoCo 4.0.0", "centred differences (mjd_transitionFD)", 100, 0.147, 583),
        ("MJX 3.17.0 (jax, float32)", "reverse mode, one solver iteration", 20, 0.74, 1.1),
        ("MJX 3.17.0 (jax, float32)", "reverse mode, one solver iteration", 100, 11.8, 51),
        ("Newton 1.8.0 (semi-implicit, dt 1e-3)", "its tape", 20, 0.56, 0.31),
        ("Newton 1.8.0 (semi-implicit, dt 1e-3)", "its tape", 100, 0.74, 0.49),
        ("Genesis 1.4.5 (float64)", "reverse mode", 20, 1.2, 17.7),
        ("Genesis 1.4.5 (float64)", "reverse mode", 100, 3.7, 134),
        ("lcp-physics (2-D)", "reverse mode", 20, 26, 14),
        ("nimblephysics 0.10.52", "reverse mode", 20, 0.96, 26),
        ("nimblephysics 0.10.52", "reverse mode", 100, 5.4, 2700),
    ),
}

# What their gradients through contact are worth.
GRADIENTS = {
    "columns": ("peer", "what was measured"),
    "rows": (
        ("Genesis 1.4.5", "equal to its own differences to 4e-9 … 3e-7 (boxes, spheres), 1e-4 in a free stack"),
        ("Genesis 1.4.5", "head-on push: dv2/dv1 = 1.875, where .5 to .62 is right: impacts are quantised"),
        ("MJX 3.17.0", "elastic bounce, exact .132: -1.0, +.29, -.96 at dt 1e-2, 1e-3, 1e-4"),
        ("Newton 1.8.0", "a gradient of 6.6e16 at friction gain 1000, without a word"),
    ),
}
