"""Cosines and sines of several angles at once, in code that is made of vector instructions.

The angle is reduced by the nearest multiple of pi / 2 in three parts (Cody and Waite 1980), and polynomials are
those of fdlibm (Sun Microsystems 1993): errors are below two and a half units in the last place up to MOST.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import outlined
from apex_ompl.kernel.compiled.layout import Floats

TOGETHER = 8  # angles
MOST = 1e5  # [rad]; beyond it the library's functions are called
PER_QUARTER = 2.0 / math.pi
WHOLE = 1.5 * 2.0**52  # which, added and subtracted, rounds to the nearest whole number
QUARTER, NEXT, LAST = 1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21
S1, S2, S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
S4, S5, S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
C1, C2, C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
C4, C5, C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@outlined
def set_sines(angles: Floats, count: int, cosines: Floats, sines: Floats) -> None:
    """Put the cosines and sines of the first ``count`` angles into place.

    The arrays have room for the next multiple of TOGETHER of them.
    """
    largest = 0.0
    for i in range(count):
        largest = max(largest, abs(angles[i]))
    if largest > MOST:
        for i in range(count):
            cosines[i], sines[i] = math.cos(angles[i]), math.sin(angles[i])
        return
    for i in range((count + TOGETHER - 1) // TOGETHER * TOGETHER):
        x = angles[i]
        n = (x * PER_QUARTER + WHOLE) - WHOLE
        r = ((x - n * QUARTER) - n * NEXT) - n * LAST
        z = r * r
        s = r + r * z * (S1 + z * (S2 + z * (S3 + z * (S4 + z * (S5 + z * S6)))))
        half = 0.5 * z
        c = 1.0 - half
        c += ((1.0 - c) - half) + z * z * (C1 + z * (C2 + z * (C3 + z * (C4 + z * (C5 + z * C6)))))
        n -= 4.0 * ((0.25 * n + WHOLE) - WHOLE)  # -2 to 2
        u, v = s if abs(n) == 1.0 else c, c if abs(n) == 1.0 else s
        cosines[i] = u if -1.0 <= n <= 0.0 else -u
        sines[i] = v if 0.0 <= n <= 1.0 else -v
