"""How the split of the load by deformation hangs on the adduction: a second press, turned a little.

The total load and every other coordinate but the height stay. A finite difference of the same
contact model: what it costs is one more warm press, and what it says holds for that model.
"""

from typing import Any

from tkamb.contact.model import ContactModel
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.geometry.frames import KNEE_COORDINATES, knee_coordinates, knee_pose
from tkamb.units import DEGREE

STEP = 0.02 * DEGREE
"""Small against the 0.2 to 0.5 deg that unload a condyle, and it moves some 60 N, thirty times
what the lattice's tolerance leaves open; steps of 0.005 to 0.1 deg agree within 5 to 15 %."""

ADDUCTION = KNEE_COORDINATES.index("adduction")


def split_sensitivity(model: ContactModel, state: Any, result: ContactResult) -> float:
    """Return the change of the medial force with the adduction at a constant load, N/rad.

    Zero where one condyle carries everything: it then holds only until the other touches. NaN
    where the turned press does not succeed.

    Args:
        model: the contact model.
        state: what its `prepare` returned.
        result: a contact; the load is what it carries along -y.
    """
    load = -float(result.wrench_on_insert[1])
    place = knee_coordinates(result.pose)
    place[ADDUCTION] += STEP
    turned = model.press(state, load, knee_pose(place), result)
    if turned.status is not ContactStatus.OK:
        return float("nan")
    return (_medial(turned) - _medial(result)) / STEP


def _medial(result: ContactResult) -> float:
    return result.medial.force if result.medial else 0.0
