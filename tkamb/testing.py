"""Check that a contact model fulfils the contract of contact models.

    from tkamb.testing import check_contact_model
    check_contact_model(MyModel(resolution=1e-3))

A missing property raises `ConformanceError`.
"""

from dataclasses import dataclass, is_dataclass
from typing import Any

import numpy as np
import trimesh

from tkamb.contact.materials import material
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import ContactPair
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.errors import TkambError
from tkamb.geometry.frames import Array, inverse, knee_pose
from tkamb.geometry.surface import Surface

SPHERE_RADIUS, SPHERE_OFFSET = 20e-3, 12e-3
"""m: radius of the two spheres, and distance of their centres from the sagittal plane."""
BLOCK = (32e-3, 10e-3, 56e-3)
"""m: lengths of the block along x, y and z."""


# 1: largest relative difference between the stiffnesses over ±10 and ±5 % of the approach.
# The force has small steps when single nodes come into contact.
STIFFNESS_TOLERANCE = 0.1


class ConformanceError(TkambError):
    """A contact model lacks a property of the contract. The message names the property."""


@dataclass(frozen=True, eq=False)
class ConformanceCase:
    """The bodies, pose, load and tolerances of the check.

    Args:
        pose: (4, 4) pose_femoral_in_insert; its y is ignored.
        load: N, compressive.
        tolerance: 1, relative tolerance of forces, approach and pressure.
        integral_tolerance: 1, relative tolerance of the integral of pressure over the map.
    """

    pair: ContactPair
    pose: Array
    load: float
    tolerance: float
    integral_tolerance: float


def check_contact_model(
    model: ContactModel,
    pair: ContactPair | None = None,
    pose: Array | None = None,
    load: float = 500.0,
    tolerance: float = 2e-3,
    integral_tolerance: float = 2e-2,
) -> None:
    """Raise unless a contact model has every property of the contract.

    Args:
        model: the contact model.
        pair: the two bodies; default: `two_sphere_pair`.
        pose: (4, 4) pose_femoral_in_insert; default: 10 deg of flexion, 0.2 deg of varus.
        load: N, compressive.
        tolerance: 1, relative tolerance of forces, approach and pressure between equivalent
            evaluations.
        integral_tolerance: 1, relative tolerance of the integral of pressure over the map.

    Raises:
        ConformanceError: the model lacks a property of the contract.
    """
    pair = two_sphere_pair() if pair is None else pair
    pose = knee_pose([0, 0, 0, 0, np.radians(0.2), np.radians(10)]) if pose is None else pose
    case = ConformanceCase(pair, pose, load, tolerance, integral_tolerance)
    _check_declaration(model)
    state = model.prepare(pair)
    _check_apart(model, state, case)
    pressed = model.press(state, load, pose)
    _check_load(model, state, case, pressed)
    _check_map(state, pressed)
    _check_integral(case, pressed)
    _check_femoral_frame(model, case, pressed)
    _check_stiffness(model, state, case, pressed)
    _check_guess(model, state, case, pressed)
    _check_limits(model, state, case)


def two_sphere_pair() -> ContactPair:
    """Return two spheres of 20 mm radius, centres 24 mm apart along z, and a polyethylene block."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=SPHERE_RADIUS)
    offset = np.array([0.0, 0.0, SPHERE_OFFSET])
    vertices = np.concatenate([sphere.vertices - offset, sphere.vertices + offset])
    faces = np.concatenate([sphere.faces, sphere.faces + len(sphere.vertices)])
    block = trimesh.creation.box(BLOCK)
    on_floor = np.array([0.0, BLOCK[1] / 2, 0.0])
    return ContactPair(
        Surface(vertices, faces.astype(np.int64), "two spheres"),
        Surface(block.vertices + on_floor, np.asarray(block.faces, np.int64), "block"),
        material("polyethylene"),
    )


def _require(holds: Any, what: str, detail: str = "") -> None:
    if not holds:
        raise ConformanceError(
            f"not fulfilled: {what}{': ' if detail else ''}{detail}", "contact model"
        )


def _close(a: Any, b: Any, tolerance: float, scale: float) -> bool:
    return bool(np.all(np.abs(np.asarray(a) - np.asarray(b)) <= tolerance * scale))


def _check_declaration(model: ContactModel) -> None:
    _require(isinstance(model, ContactModel), "it is a ContactModel")
    frozen = is_dataclass(model) and type(model).__dataclass_params__.frozen
    _require(frozen, "it is a frozen dataclass of parameters")
    for word in ("name", "assumes", "needs"):
        text = getattr(model, word, None)
        _require(isinstance(text, str) and text and "\n" not in text, f"'{word}' is one line")
    _require(getattr(model, "resolution", 0) > 0, "'resolution' is a positive length (m)")


def _check_apart(model: ContactModel, state: Any, case: ConformanceCase) -> None:
    what = "there is no wrench when apart"
    result = model.evaluate(state, case.pair.pose_at_approach(case.pose, -1e-3))
    _require(result.status is ContactStatus.OK, what, f"status {result.status.value}")
    _require((result.wrench_on_insert == 0).all() and (result.pressure == 0).all(), what)
    _require(result.medial is None and result.lateral is None, what, "a condyle carries force")
    _require(result.approach == 0, what, f"approach {result.approach}")
    _require((result.gap > 0).all(), "gaps are positive when apart")


def _check_load(
    model: ContactModel, state: Any, case: ConformanceCase, pressed: ContactResult
) -> None:
    what = "the load is reached within tolerance"
    _require(pressed.status is ContactStatus.OK, what, "; ".join(pressed.flags))
    reaction = -pressed.wrench_on_insert[1]
    _require(_close(reaction, case.load, case.tolerance, case.load), what, f"{reaction} N")
    all_but_y = np.delete(np.arange(16), 7)
    _require(
        _close(
            pressed.pose.ravel()[all_but_y], np.asarray(case.pose).ravel()[all_but_y], 1e-12, 1.0
        ),
        "pressing keeps rotation, x and z",
    )
    again = model.evaluate(state, pressed.pose)
    travelled = case.pair.first_touch_height(case.pose) - pressed.pose[1, 3]
    _require(travelled > 0, "pressing moves the femoral component into the insert")
    for result in (pressed, again):
        _require(
            _close(result.approach, travelled, 1e-9, 1.0),
            "the approach is the travel since touch",
            f"{result.approach} m for {travelled} m",
        )
    _require(
        _close(again.wrench_on_insert[:3], pressed.wrench_on_insert[:3], case.tolerance, case.load),
        "evaluating the pressed pose gives the pressed force",
    )


def _check_map(state: Any, pressed: ContactResult) -> None:
    n = len(state.points)
    for name in ("points", "normals", "nodal_force"):
        _require(getattr(pressed, name).shape == (n, 3), f"'{name}' is (n, 3) on the map's points")
    for name in ("pressure", "area", "gap"):
        _require(getattr(pressed, name).shape == (n,), f"'{name}' is (n,) on the map's points")
    _require(np.array_equal(pressed.points, state.points), "the map's points do not change")
    _require(np.asarray(state.triangles).max() < n, "triangles join the map's points")
    _require((pressed.pressure >= 0).all(), "pressure is not negative")
    _require((pressed.area > 0).all(), "tributary areas are positive")
    lengths = np.linalg.norm(pressed.normals, axis=1)
    _require(_close(lengths, 1.0, 1e-6, 1.0), "normals have unit length")


def _check_integral(case: ConformanceCase, pressed: ContactResult) -> None:
    what = "the wrench is the integral of pressure"
    force, moment = pressed.wrench_on_insert[:3], pressed.wrench_on_insert[3:]
    nodal = pressed.nodal_force
    _require(_close(nodal.sum(axis=0), force, 1e-9, case.load), what, "sum of nodal forces")
    moments = np.cross(pressed.points, nodal).sum(axis=0)
    arm = np.abs(pressed.points).max()
    _require(_close(moments, moment, case.integral_tolerance, case.load * arm), what, "moment")
    spread = -(pressed.pressure * pressed.area) @ pressed.normals
    _require(_close(spread[1], force[1], case.integral_tolerance, case.load), what, f"{spread} N")
    condyles = [c for c in (pressed.medial, pressed.lateral) if c is not None]
    total = sum(c.force for c in condyles)
    _require(
        total >= (1 - case.integral_tolerance) * np.linalg.norm(force),
        "the condyles carry the whole force",
        f"{total} N",
    )
    for c in condyles:
        _require(_close(c.force, c.mean_pressure * c.area, 1e-6, c.force), "mean = force / area")


def _check_femoral_frame(
    model: ContactModel, case: ConformanceCase, pressed: ContactResult
) -> None:
    """Check that the result does not depend on the femoral mesh's frame, here rotated about z so
    that medial and lateral do not change.

    With a fixed insert frame this is equivalent to moving both bodies.
    """
    other = knee_pose([3e-3, -5e-3, 0.5e-3, 0.0, 0.0, np.radians(25)])
    pair = ContactPair(
        case.pair.femoral.moved(other), case.pair.insert, case.pair.material, case.pair.bearing
    )
    result = model.press(model.prepare(pair), case.load, case.pose @ inverse(other))
    what = "moving both bodies together changes nothing"
    _require(_close(result.approach, pressed.approach, case.tolerance, pressed.approach), what)
    _require(
        _close(
            result.wrench_on_insert[:3], pressed.wrench_on_insert[:3], case.tolerance, case.load
        ),
        what,
    )
    peak = pressed.pressure.max()
    _require(_close(result.pressure.max(), peak, 5 * case.tolerance, peak), what, "peak pressure")


def _check_stiffness(
    model: ContactModel, state: Any, case: ConformanceCase, pressed: ContactResult
) -> None:
    depth = pressed.approach
    steps = depth * np.array([-0.1, -0.05, 0.0, 0.05, 0.1])
    forces = np.array(
        [
            -model.evaluate(
                state, case.pair.pose_at_approach(case.pose, depth + step)
            ).wrench_on_insert[1]
            for step in steps
        ]
    )
    _require((np.diff(forces) > 0).all(), "the reaction grows with the approach", f"{forces} N")
    wide = (forces[4] - forces[0]) / (steps[4] - steps[0])
    narrow = (forces[3] - forces[1]) / (steps[3] - steps[1])
    _require(
        _close(wide, narrow, STIFFNESS_TOLERANCE, narrow),
        "the stiffness by finite differences converges as the step shrinks",
        f"{wide:.4g} and {narrow:.4g} N/m",
    )


def _check_guess(
    model: ContactModel, state: Any, case: ConformanceCase, pressed: ContactResult
) -> None:
    what = "an initial guess does not change the result"
    peak = pressed.pressure.max()
    for share in (0.2, 3.0):
        for guess in model.press_from(state, share * case.load, case.pose):
            result = model.press(state, case.load, case.pose, guess)
            approach = result.approach
            _require(_close(approach, pressed.approach, case.tolerance, pressed.approach), what)
            _require(_close(result.pressure, pressed.pressure, 10 * case.tolerance, peak), what)
            force = model.evaluate(state, pressed.pose, guess).wrench_on_insert[1]
            _require(_close(-force, case.load, 2 * case.tolerance, case.load), what, f"{-force} N")


def _check_limits(model: ContactModel, state: Any, case: ConformanceCase) -> None:
    touching = model.press(state, 0.0, case.pose)
    what = "zero load gives first touch"
    _require(touching.status is ContactStatus.OK and touching.approach == 0, what)
    _require((touching.wrench_on_insert == 0).all() and (touching.pressure == 0).all(), what)
    what = "a load that cannot be reached gives OUT_OF_RANGE and NaN"
    for shift in (1.0, np.nan):
        away = np.array(case.pose, float)
        away[0, 3] += shift
        pressed_away = model.press(state, case.load, away)
        _require(pressed_away.status is ContactStatus.OUT_OF_RANGE, what, pressed_away.status.value)
        _require(
            np.isnan(pressed_away.wrench_on_insert).all() and np.isnan(pressed_away.approach), what
        )
        _require(pressed_away.medial is None and pressed_away.lateral is None, what)
