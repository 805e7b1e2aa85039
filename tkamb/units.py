"""Factors from units of files to SI. Inside the package, values are in SI and angles in radians."""

import math

MILLIMETRE = 1e-3
MEGAPASCAL = 1e6
DEGREE = math.pi / 180.0
STANDARD_GRAVITY = 9.80665
"""Standard gravity, m/s² (CGPM 1901)."""

LENGTH = {"m": 1.0, "cm": 1e-2, "mm": MILLIMETRE, "inch": 0.0254}
"""Metres per unit of length."""

ANGLE = {"rad": 1.0, "deg": DEGREE}
"""Radians per unit of angle."""
