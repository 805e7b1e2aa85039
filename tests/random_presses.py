"""Compare random presses of the lattice, from random initial guesses, with precise solutions.

The precise solutions have a tolerance of 1e-6.
"""

import numpy as np

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.geometry.frames import knee_pose

ALLOWED = (5e-4, 1e-3, 2e-3)
"""Largest relative errors of approach, peak pressure and area."""
STARTS = ("cold", "warm", "heavier", "wrong pose")


def prepared(mm, tolerance=1e-3):
    """Return the lattice with a cell size (mm), and its state for condyles on a dished insert."""
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    model = contact_model("lattice", resolution=mm * 1e-3, tolerance=tolerance)
    return model, model.prepare(bodies)


def pose_of(rng):
    """Return a random pose near the neutral one."""
    x, z = rng.uniform([-2e-3, -1e-3], [2e-3, 1e-3])
    angles = np.radians(rng.uniform([-0.5, -3.0, -5.0], [0.5, 3.0, 5.0]))
    return knee_pose([x, 0.0, z, *angles])


def presses(model, state, reference, reference_state, rng, cases):
    """Yield load, start, status and errors of random presses between 1 N and 24 kN.

    Args:
        model: lattice with the tolerance under test.
        state: state that `model` prepared.
        reference: lattice with a tolerance of 1e-6.
        reference_state: state that `reference` prepared.
        rng: random generator of numpy.
        cases: number of presses.
    """
    last = None
    for _ in range(cases):
        load, pose = float(np.exp(rng.uniform(0.0, np.log(24e3)))), pose_of(rng)
        kind, start = STARTS[rng.integers(4)], None
        if kind == "warm":
            neighbour = pose.copy()
            neighbour[:3, 3] += [1e-4, 0.0, 0.0]
            _, start = model.press_from(state, load, neighbour)
        elif kind == "heavier":
            _, start = model.press_from(state, min(4 * load, 24e3), pose)
        elif kind == "wrong pose":
            start = last
        result, last = model.press_from(state, load, pose, start)
        precise = reference.press(reference_state, load, pose, last)
        case = {"load_N": round(load, 1), "start": kind, "status": result.status.value}
        case |= {"passes": result.iterations, "residual": result.residual}
        if precise.status is not ContactStatus.OK:
            yield case | {"errors": [np.nan] * 3, "reference": precise.status.value}
            continue
        areas = [
            sum(c.area for c in (contact.medial, contact.lateral) if c is not None)
            for contact in (result, precise)
        ]
        errors = (
            abs(result.approach / precise.approach - 1),
            abs(result.pressure.max() / precise.pressure.max() - 1),
            abs(areas[0] / areas[1] - 1),
        )
        yield case | {"errors": [float(f"{error:.3g}") for error in errors]}
