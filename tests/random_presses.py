"""Compare random presses of the lattice from random initial guesses with solutions to 1e-6."""

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
    """Return the lattice of a cell size, and its state on two condyles over a dished insert."""
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    model = contact_model("lattice", mm, tolerance=tolerance)
    return model, model.prepare(bodies)


def pose_of(rng):
    """Return a random pose within some millimetres and degrees."""
    x, z = rng.uniform([-2e-3, -1e-3], [2e-3, 1e-3])
    turned = np.radians(rng.uniform([-0.5, -3.0, -5.0], [0.5, 3.0, 5.0]))
    return knee_pose([x, 0.0, z, *turned])


def presses(model, state, wanted, exact, rng, cases):
    """Yield load, start, status and errors of random presses between 1 N and 24 kN.

    Args:
        model: lattice with the tolerance under test.
        state: the state that `model` prepared.
        wanted: lattice with a tolerance of 1e-6, for the reference solutions.
        exact: the state that `wanted` prepared.
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
        found, last = model.press_from(state, load, pose, start)
        best = wanted.press(exact, load, pose, last)
        case = {"load_N": round(load, 1), "start": kind, "status": found.status.value}
        case |= {"passes": found.iterations, "residual": found.residual}
        if best.status is not ContactStatus.OK:
            yield case | {"errors": [np.nan] * 3, "reference": best.status.value}
            continue
        areas = [
            sum(c.area for c in (one.medial, one.lateral) if c is not None) for one in (found, best)
        ]
        errors = (
            abs(found.approach / best.approach - 1),
            abs(found.pressure.max() / best.pressure.max() - 1),
            abs(areas[0] / areas[1] - 1),
        )
        yield case | {"errors": [float(f"{error:.3g}") for error in errors]}
