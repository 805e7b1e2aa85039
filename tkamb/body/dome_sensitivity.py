"""How much quadriceps and patellofemoral force hang on where the button sits on the patella.

The patellofemoral force passes through the button's contact with the femur, and quadriceps and
patellar ligament are weighed against each other by their arms about that line. Quadriceps and
ligament run along the patella, so a button that sits higher or lower on it (the patella's y
axis) moves the line across; one that sits deeper (x) moves it along itself and changes little.
Nobody knows that place to a millimetre.

The line is moved by ±0.5 mm along the patella's y axis with the patella's place kept, and the
frame is solved again: central difference. Measured per millimetre on the shipped knee, from
extension to 120 deg: Q 1.6 to 5.6 % and PF 1.0 to 4.3 % along y; Q 0.1 to 2.2 % along x. A
patella that is free to find its balance anew turns by up to 1 deg per millimetre and evens most
of it out: along y Q then changes by at most 1.6 % and PF by 1.3 % (along x: PF by 7 %, in
extension). So the columns are the larger estimate for Q.
"""

from dataclasses import replace

import numpy as np

from tkamb.body.knee import KneeGeometry, solve_knee
from tkamb.units import MILLIMETRE

SHIFT = 0.5 * MILLIMETRE
FORCES = ("quadriceps", "patellofemoral")


def dome_sensitivity(geometry: KneeGeometry, friction: float) -> dict[str, float]:
    """Return force -> change per metre that the button sits higher on the patella, N/m.

    Empty without an extensor mechanism; NaN where a neighbour has no solution.

    Args:
        geometry: the frame as it was solved, insert frame.
        friction: Coulomb coefficient of the femorotibial contact.
    """
    extensor = geometry.extensor
    if extensor is None:
        return {}
    up = geometry.state.pose("patella")[:3, 1]
    lower, higher = (
        solve_knee(
            replace(
                geometry,
                extensor=replace(extensor, contact_point=extensor.contact_point + shift * up),
            ),
            friction,
        ).values
        for shift in (-SHIFT, SHIFT)
    )
    nan = np.nan
    return {f: (higher.get(f, nan) - lower.get(f, nan)) / (2 * SHIFT) for f in FORCES}
