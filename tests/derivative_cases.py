"""Knees, random states and central differences for derivatives of forces.

Columns and nodes that come into contact, and taut ligaments give the forces kinks. On a kink the
two one-sided derivatives differ, and a derivative can agree with one of them only. Where a column
of the foundation crosses an edge of two femoral facets, its force turns by less than a mrad. Only
steps that end before this jump agree with the derivative.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import cycle

import numpy as np
import pinocchio as pin

import tkamb
from knee_bodies import mirrored_se3, whole_body
from test_knee import at, pressed
from test_knee_plain_model import state_of, without_patella
from tkamb.contact.lattice import model as lattice_model
from tkamb.contact.lattice.linear import compliance
from tkamb.knee import patella_search

TOLERANCE = 1e-5
"""Relative error of a column, see `errors`."""
SHORT, LONG = (1e-9, 1e-8), (1e-9, 1e-8, 1e-7, 1e-6)
"""m: steps of central differences with and without contact."""
RATES = (1e-6, 1e-5)
"""m/s: steps in v; the friction bends within 1 mm/s."""
TENSIONS = {"hamstrings": 150.0}


def sharpen(monkeypatch):
    """Make the iterative parts end at rounding errors, because a difference divides by the step."""
    sharp = replace(
        patella_search.PATELLA_SEARCH,
        length_tolerance=1e-13,
        rotation_tolerance=1e-11,
        max_evaluations=30,
    )
    monkeypatch.setattr(patella_search, "PATELLA_SEARCH", sharp)
    for module in (lattice_model, compliance):
        monkeypatch.setattr(module, "SINGLE", np.float64)


def vectors(forces):
    return np.array([force.vector for force in forces])


def step_sizes(model, step):
    """Return the step (nv,) of each direction; that of an angle is 40 times, for 25 mm."""
    sizes = np.full(model.nv, step)
    for joint in model.joints:
        if joint.nv == 0:
            continue
        lengths = {"JointModelFreeFlyer": 3, "JointModelTranslation": 3}.get(joint.shortname(), 0)
        if joint.shortname().startswith("JointModelP"):
            lengths = 1
        sizes[joint.idx_v + lengths : joint.idx_v + joint.nv] *= 40.0
    return sizes


def slopes(values, knee, q, v, step, rate):
    """Return central differences of values by q and v, in the last axis."""
    model, found = knee.model, []
    for by_v, sizes in ((False, step_sizes(model, step)), (True, np.full(model.nv, rate))):
        columns = [
            (moved(values, model, q, v, k, size, by_v) - moved(values, model, q, v, k, -size, by_v))
            / (2.0 * size)
            for k, size in enumerate(sizes)
        ]
        found.append(np.moveaxis(np.array(columns), 0, -1))
    return found


def moved(values, model, q, v, k, size, by_v=False):
    """Return the values after a step of one direction."""
    move = size * np.eye(model.nv)[k]
    return values(q, v + move) if by_v else values(pin.integrate(model, q, move), v)


def one_sided(values, step):
    """Return the changes over a step of values of a number by the one-sided second-order slopes."""
    here, found = values(0.0), []
    for sign in (1.0, -1.0):
        near, far = (values(n * sign * step) for n in (1, 2))
        found.append(sign * (-3.0 * here + 4.0 * near - far) / 2.0)
    return found


def kink_error(values, slope, size, steps):
    """Return the error of a slope on its own side of a kink; None: there is no kink, or it misses.

    There is a kink if the one-sided differences by every step differ by more than `TOLERANCE`. On
    its own side the slope agrees with one of them within `TOLERANCE`.

    Args:
        values: function of the distance along a direction.
        slope: computed derivative by this distance.
        size: value to which errors are relative.
        steps: steps; steps between and below them are tried, too.
    """
    jumps, found = [], []
    for step in np.geomspace(0.1 * min(steps), max(steps), 5):
        ahead, behind = (side / step for side in one_sided(values, step))
        jumps.append(np.abs(ahead - behind).max() / size)
        found += [np.abs(slope - side).max() / size for side in (ahead, behind)]
    best = float(min(found))
    return best if min(jumps) > TOLERANCE and best < TOLERANCE else None


def along(values, model, q, v, unit):
    """Return values of q and v as a function of the distance along a direction (nv,) of q."""
    return lambda distance: values(pin.integrate(model, q, distance * unit), v)


def errors(computed, expected):
    """Return the error of each column, relative to it or to 1e-3 of the largest column."""
    axes = tuple(range(expected.ndim - 1))
    size = np.abs(expected).max(axis=axes)
    if not size.any():
        return np.abs(computed).max(axis=axes)
    size = np.maximum(size, 1e-3 * size.max())
    return np.abs(computed - expected).max(axis=axes) / size


@dataclass
class Agreement:
    """The errors of one state.

    Args:
        smooth: largest error of the columns without a kink, relative to central differences.
        kinks: number of columns on a kink.
        kink: largest error of the columns on a kink, relative to the better one-sided difference.
    """

    smooth: float
    kinks: int
    kink: float


def agreement(values, computed, knee, q, v, steps=SHORT):
    """Compare derivatives by q and v with differences.

    Of each column the best of all steps counts: the longer one has less rounding, the shorter one
    meets fewer kinks. A column by q that misses `TOLERANCE` lies on a kink if its one-sided
    differences differ by more than that, and one of them agrees.
    """
    found = [
        [errors(*pair) for pair in zip(computed, slopes(values, knee, q, v, *sizes), strict=True)]
        for sizes in zip(steps, cycle(RATES), strict=False)
    ]
    by_q, by_v = np.min(found, axis=0)
    size = np.abs(computed[0]).max(axis=tuple(range(computed[0].ndim - 1)))
    size = np.maximum(size, 1e-3 * size.max())
    smooth, on_kinks = [float(by_v.max())], []
    units = np.diag(step_sizes(knee.model, 1.0))
    for k, error in enumerate(by_q):
        kink = None
        if error > TOLERANCE:
            slope = computed[0][..., k] * units[k, k]
            relative = size[k] * units[k, k]
            line = along(values, knee.model, q, v, units[k])
            kink = kink_error(line, slope, relative, steps)
        if kink is None:
            smooth.append(float(error))
        else:
            on_kinks.append(kink)
    return Agreement(max(smooth), len(on_kinks), max(on_kinks, default=0.0))


def direction_agreement(values, computed, knee, q, v, steps=SHORT):
    """Compare derivatives along one random direction of q, and of v, with differences.

    The best of all steps counts, and a miss by q may lie on a kink, as in `agreement`.
    """
    model, rng = knee.model, np.random.default_rng(int(1e6 * abs(q[-1])) % 1000)
    unit = rng.choice([-1.0, 1.0], model.nv) * rng.uniform(0.5, 1.0, model.nv)
    smooth, kinks = [], []
    for by_v in (False, True):
        found, scale = [], np.ones(model.nv) if by_v else step_sizes(model, 1.0)
        slope = computed[by_v] @ (scale * unit)
        for step in RATES if by_v else steps:
            move = step * scale * unit
            ends = [
                values(q, v + s * move) if by_v else values(pin.integrate(model, q, s * move), v)
                for s in (1.0, -1.0)
            ]
            change = (ends[0] - ends[1]) / (2.0 * step)
            size = np.abs(change).max() or 1.0
            found.append(np.abs(slope - change).max() / size)
        kink = None
        if min(found) > TOLERANCE and not by_v:
            kink = kink_error(along(values, model, q, v, scale * unit), slope, size, steps)
        if kink is None:
            smooth.append(float(min(found)))
        else:
            kinks.append(kink)
    return Agreement(max(smooth), len(kinks), max(kinks, default=0.0))


def direction_error(values, computed, knee, q, v, steps=SHORT):
    """Return the error of `direction_agreement` away from kinks."""
    return direction_agreement(values, computed, knee, q, v, steps).smooth


def forces_of(case):
    """Return the forces of a case as a function of q and v."""
    return lambda q, v: vectors(case.knee.external_forces(q, v, case.tensions))


def case_directions(case, count):
    """Return the agreement of each of `count` states along a random direction."""
    found = []
    for q, v in case.states(count):
        computed = case.knee.external_forces_derivatives(q, v, case.tensions)
        one = direction_agreement(forces_of(case), computed, case.knee, q, v, case.steps)
        found.append(one)
    return found


def case_agreements(case, count):
    """Return the agreement of each of `count` states, column by column."""
    found = []
    for q, v in case.states(count):
        computed = case.knee.external_forces_derivatives(q, v, case.tensions)
        found.append(agreement(forces_of(case), computed, case.knee, q, v, case.steps))
    return found


def random_states(read, knee, count, load=1000.0, seed=0):
    """Yield random states near recorded frames; the condyles carry about the load."""
    rng, motion = np.random.default_rng(seed), read[1]
    model = knee.model
    columns = list(range(6, 12))
    for _ in range(count):
        k = int(rng.integers(20, 95))
        move = np.zeros(model.nv)
        move[columns] = rng.uniform(-1, 1, 6) * [2e-3, 0, 1e-3, 0.03, 0.005, 0.05]
        q = pin.integrate(model, motion.q[k], move)
        v = motion.v[k] + 0.1 * rng.standard_normal(model.nv)
        yield pressed(knee, q, load * rng.uniform(0.5, 1.5)) if load else q, v


def knee_of(plain, name="foundation", resolution=3e-3, options=None, **changes):
    model = tkamb.contact_model(name, resolution=resolution, **(options or {})) if name else None
    parts = {
        "implant": plain.implant,
        "ligaments": plain.ligaments,
        "contact": model,
        "friction": 0.05 if name else 0.0,
    }
    return tkamb.Knee(plain.model, **(parts | changes))


@dataclass
class Case:
    """A knee with its states.

    Args:
        knee: the knee.
        states: function from a number to that many states (q, v).
        tensions: tensions of muscles.
        steps: steps of the central differences, m.
    """

    knee: tkamb.Knee
    states: Callable[[int], Iterator]
    tensions: dict | float | None = None
    steps: tuple = SHORT


def contact_case(read, name, **parts):
    knee = knee_of(read[0], name, **parts)
    return Case(knee, lambda count: random_states(read, knee, count))


def lattice_case(read, name, newton):
    options = {"tolerance": 1e-9, "newton": newton, "cache": False}
    resolution = 3e-3 if newton else 2e-3
    knee = knee_of(read[0], name, resolution, options)
    return Case(knee, lambda count: random_states(read, knee, count), steps=LONG)


def hamstrings(plain):
    points = (("femur", (-0.02, 0.2, 0.0)), ("femur", (-0.02, 0.05, 0.0)))
    return tkamb.Muscle("hamstrings", (*points, ("tibia", (-0.03, 0.3, 0.01))))


def lines_case(read):
    """The quadriceps, wrapped or not, a straight muscle, and a patella that the model moves."""
    plain = read[0]
    knee = knee_of(plain, None, extensor=plain.extensor, muscles=[hamstrings(plain)])
    tensions = TENSIONS | {plain.extensor.quadriceps.name: 500.0}
    return Case(knee, lambda count: random_states(read, knee, count, load=0.0), tensions, LONG)


def ligaments_case(read):
    knee = knee_of(read[0], None)
    return Case(knee, lambda count: random_states(read, knee, count, load=0.0), steps=LONG)


def solved_patella_case(read, left):
    """A free-flying leg without a patella, whose equilibrium follows the femur."""
    whole = without_patella(read[0], left)
    parts = {"implant": whole.implant, "extensor": whole.extensor}
    knee = tkamb.Knee(whole.model, side="left" if left else "right", **parts)

    def states(count):
        rng = np.random.default_rng(1)
        for _ in range(count):
            q = state_of(read, int(rng.integers(20, 95)))[0]
            if left:
                poses = [mirrored_se3(pin.XYZQUATToSE3(part)) for part in (q[:7], q[7:])]
                q = np.concatenate([pin.SE3ToXYZQUAT(pose) for pose in poses])
            move = np.zeros(12)
            move[6:] = rng.uniform(-1, 1, 6) * [1e-3, 1e-4, 1e-3, 0.01, 0.02, 0.03]
            yield pin.integrate(knee.model, q, move), 0.1 * rng.standard_normal(12)

    return Case(knee, states, 600.0, LONG)


def body_case(read, left):
    """Pelvis, free knee and free patella in a humanoid: all loads together."""
    pin.seed(2)
    plain, body = read[0], whole_body(read[0], left=left)

    def states(count):
        rng = np.random.default_rng(5)
        for _ in range(count):
            q, v, a, external = at(read, int(rng.integers(20, 95)))
            q = pressed(plain, q, 1000.0 * rng.uniform(0.5, 1.5))
            yield body.state(q, v, a, external)[:2]

    return Case(body.knee, states, 400.0)


def mimic_case(read):
    """A femur on a chain of joints, whose AP translation follows the axial rotation."""
    plain, model, joint = read[0], pin.Model(), 0
    model.addFrame(pin.Frame("tibia", 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    for name in ("RY", "PX", "PY", "PZ", "RX", "RZ"):
        kind = getattr(pin, f"JointModel{name}")()
        joint = model.addJoint(joint, kind, pin.SE3.Identity(), name)
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    model.addFrame(pin.Frame("femur", joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    slide, driver = model.getJointId("PX"), model.getJointId("RY")
    model = pin.transformJointIntoMimic(model, driver, slide, 2e-3, -6.9e-3)
    contact = tkamb.contact_model("foundation", resolution=3e-3)
    knee = tkamb.Knee(model, implant=plain.implant, contact=contact, friction=0.05)
    up = model.joints[model.getJointId("PY")].idx_q

    def states(count):
        rng = np.random.default_rng(6)
        for _ in range(count):
            q = rng.uniform(-1, 1, model.nq) * 0.02
            q[up], q[model.joints[model.getJointId("PZ")].idx_q] = 0.0, 1e-3 * rng.uniform(-1, 1)
            height = knee.press(q, 1000.0 * rng.uniform(0.5, 1.5)).pose.translation[1]
            q[up] += height - knee.pose(q).translation[1]
            yield q, 0.1 * rng.standard_normal(model.nv)

    return Case(knee, states)


@dataclass
class Both:
    """Two knees of one model, with the sum of their forces."""

    model: pin.Model
    knees: tuple

    def external_forces(self, q, v, tensions=None, data=None):
        parts = [vectors(knee.external_forces(q, v)) for knee in self.knees]
        return pin.StdVec_Force([pin.Force(one) for one in sum(parts)])

    def external_forces_derivatives(self, q, v, tensions=None, data=None):
        parts = [knee.external_forces_derivatives(q, v) for knee in self.knees]
        return tuple(sum(part) for part in zip(*parts, strict=True))


def two_knees_case(read):
    """A right and a left leg without patellae, appended to one model."""
    right, left = (without_patella(read[0], side) for side in (False, True))
    model = pin.Model(right.model)
    offset = model.njoints - 1
    other = left.model
    for joint in range(1, other.njoints):
        parent = other.parents[joint]
        parent = parent + offset if parent else 0
        name = f"left_{other.names[joint]}"
        added = model.addJoint(
            parent, pin.JointModelFreeFlyer(), other.jointPlacements[joint], name
        )
        model.appendBodyToJoint(added, other.inertias[joint], pin.SE3.Identity())
    names = ("tibia", "insert", "femur", "hip")
    for name in names:
        frame = other.frames[other.getFrameId(name)]
        parent = frame.parentJoint + offset
        model.addFrame(pin.Frame(f"left_{name}", parent, 0, frame.placement, pin.FrameType.BODY))
    contact = tkamb.contact_model("foundation", resolution=3e-3)

    def renamed(line):
        ends = ((f"left_{end.link}", tuple(end.position)) for end in (line.proximal, line.distal))
        return replace(line, **dict(zip(("proximal", "distal"), ends, strict=True)))

    one = tkamb.Knee(model, implant=right.implant, ligaments=right.ligaments, contact=contact)
    two = tkamb.Knee(
        model,
        side="left",
        implant=left.implant,
        ligaments=[renamed(line) for line in left.ligaments],
        contact=contact,
        frames={name: f"left_{name}" for name in names},
    )

    def states(count):
        rng, motion = np.random.default_rng(7), read[1]
        for _ in range(count):
            parts = []
            for side in (False, True):
                k = int(rng.integers(20, 95))
                q = pressed(read[0], motion.q[k], 1000.0 * rng.uniform(0.5, 1.5))
                root = pin.XYZQUATToSE3(state_of(read, k)[0][:7])
                poses = [root, read[0].pose(q)]
                poses = [mirrored_se3(pose) for pose in poses] if side else poses
                parts += [pin.SE3ToXYZQUAT(pose) for pose in poses]
            yield np.concatenate(parts), 0.1 * rng.standard_normal(24)

    return Case(Both(model, (one, two)), states)


CASES: dict[str, Callable[..., Case]] = {
    "foundation": lambda read: contact_case(read, "foundation"),
    "foundation-linear": lambda read: contact_case(read, "foundation-linear"),
    "lattice-linear": lambda read: lattice_case(read, "lattice-linear", False),
    "lattice": lambda read: lattice_case(read, "lattice", True),
    "fe": lambda read: lattice_case(read, "fe", True),
    "ligaments": ligaments_case,
    "muscle, wrapped quadriceps, moving patella": lines_case,
    "solved patella, right": lambda read: solved_patella_case(read, False),
    "solved patella, left": lambda read: solved_patella_case(read, True),
    "whole body, right": lambda read: body_case(read, False),
    "whole body, left": lambda read: body_case(read, True),
    "mimic joint": mimic_case,
    "two knees": two_knees_case,
}
"""Words -> function from a read scene to a case."""
