"""Random equilibria of a knee with a released patella, and differences of their derivatives.

The reference is the equilibrium of knee and patella together, converged to rounding errors. A state
on a kink is recognised as in `derivative_cases`: its one-sided differences differ at every step.
"""

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from derivative_cases import TOLERANCE, kink_error
from knee_bodies import moved, whole_body
from patella_bodies import body_knee
from tkamb.geometry.frames import KNEE_COORDINATES, knee_pose
from tkamb.knee import balance, patella_body, released

ALL = ("ap", "ml", "axial_rotation", "adduction")
CHOICES = (ALL, ("adduction",), ("ap", "ml"), ("ap", "axial_rotation", "adduction"))
STATES = 24
ARM = 0.025
"""m: lever arm of rotations."""
MOVE = 3e-7
"""m: movement of the knee by the longest step of the central differences."""
LONGEST = {"load": 0.3, "held": 1e-6, "slack": 1e-6, "stiffness": 1e-3}
"""Parameter -> its longest step: N, m, m, and a share of the stiffness."""
SHARES = np.array([0.1, 0.03, 0.3, 1.0])
"""Steps over the longest, in the order in which they are tried."""


def released_knee(plain):
    """Return a knee with both contacts and the ligaments of the shipped one."""
    source = plain[0]
    made = body_knee(source, released=True, contact=source.contact, friction=0.05)
    return made.with_ligaments([*made.ligaments, *source.ligaments])


def sharpen(monkeypatch):
    """Let both searches end at rounding errors, because a difference divides by the step."""
    search = replace(balance.BALANCE, force_tolerance=1e-8, step_tolerance=1e-13)
    monkeypatch.setattr(balance, "BALANCE", search)
    for module in (balance, patella_body):
        monkeypatch.setattr(module, "SMALL_RESIDUAL", 1e-14)
    passes = replace(
        released.RELEASED_KNEE,
        knee_tolerance=1e-13,
        contact_force_tolerance=1e-8,
        contact_force_share=0.0,
        tension_tolerance=1e-13,
        max_passes=60,
    )
    monkeypatch.setattr(released, "RELEASED_KNEE", passes)


@dataclass
class State:
    """A random state of a knee, with changes of its parameters.

    Args:
        knee: knee of the user.
        plain: knee of the plain chain, on which `q`, `v`, `a` and `fext` are.
        convert: function from a state of the plain chain to one of the knee.
        ligaments: ligaments of the user.
        released: names of the released coordinates.
    """

    knee: object
    plain: object
    convert: object
    ligaments: list
    released: tuple
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    fext: object

    def equilibrium(self, load=None, held=None, slack=None, stiffness=None, **options):
        """Return the equilibrium with changed parameters.

        Args:
            load: wrench (6,) on the tibia about the insert's origin, insert frame, N and N·m.
            held: change (6,) of the knee coordinates, m and rad.
            slack: changes (m,) of the slack lengths, m.
            stiffness: factors (m,) of the stiffnesses.
        """
        q, knee = self.q, self.knee
        if held is not None:
            signs = knee._coordinate_signs
            moved = self.plain.coordinates(q) + signs * held
            q = self.plain.bridge.configuration(q, knee_pose(moved))
        q, v, a, fext = self.convert(q, self.v, self.a, self.fext)
        if load is not None:
            joint, place = knee.anatomy.tibia.joint, knee.bridge.insert.placement
            assert knee.bridge.insert.joint == joint
            fext = pin.StdVec_Force(fext)
            fext[joint] = fext[joint] + place.act(pin.Force(load))
        bundles = self.ligaments
        if slack is not None:
            bundles = [
                replace(b, slack_length=b.slack_length + s)
                for b, s in zip(bundles, slack, strict=True)
            ]
        if stiffness is not None:
            bundles = [
                replace(b, law=b.law.stiffened(s)) for b, s in zip(bundles, stiffness, strict=True)
            ]
        if slack is not None or stiffness is not None:
            knee = knee.with_ligaments(bundles)
        return knee.equilibrium(q, v, a, fext, released=self.released, **options)


def rows(found):
    """Return the eight rows of an equilibrium, rotations times `ARM`."""
    sides = found.search.contact.condyles
    forces = [sides[side].force if side in sides else 0.0 for side in ("medial", "lateral")]
    return np.array([*found.coordinates[:3], *ARM * found.coordinates[3:], *forces])


def directions(state, found, rng):
    """Yield parameter, random change of it by 1, and computed change (8,) of the rows."""
    slopes, knee = found.derivatives, state.knee
    arms = np.repeat([1.0, ARM, 1.0], [3, 3, 2])
    load = rng.uniform(-1.0, 1.0, 6) * arms[:6]
    yield "load", load, arms * (slopes.by_load @ load)
    held = [name not in ("si", *state.released) for name in KNEE_COORDINATES]
    move = rng.uniform(-1.0, 1.0, 6) * held / arms[:6]
    yield "held", move, arms * (slopes.by_coordinate @ move)
    count = len(knee.ligaments)
    change = rng.uniform(-1.0, 1.0, count)
    yield "slack", change, arms * (slopes.by_slack_length @ change)
    values = np.array([bundle.law.stiffness for bundle in knee.ligaments])
    yield "stiffness", change, arms * (slopes.by_stiffness @ (change * values))


@dataclass
class Comparison:
    """Error of a derivative, relative to the largest change of free coordinates, or of forces.

    Args:
        error: beside central differences; on a kink beside the better one-sided difference.
        kink: whether the state lies on a kink.
    """

    error: float
    kink: bool = False


def compared(state, parameter, change, slope):
    """Compare the computed change (8,) of the rows with differences of equilibria."""
    free = [k for k, name in enumerate(KNEE_COORDINATES) if name in ("si", *state.released)]
    moves = float(np.abs(slope[free]).max())
    sizes = np.repeat([moves, np.abs(slope[6:]).max()], [6, 2])
    slope, steps = slope / sizes, SHARES * min(LONGEST[parameter], MOVE / moves)

    def values(distance):
        given = distance * change + (parameter == "stiffness")
        solved = state.equilibrium(**{parameter: given})
        assert not solved.failed, solved.reason
        return rows(solved) / sizes

    found = []
    for step in steps:
        difference = (values(step) - values(-step)) / (2.0 * step)
        found.append(float(np.abs(slope - difference).max()))
        if found[-1] < TOLERANCE:
            break
    error = min(found)
    kink = None if error < TOLERANCE else kink_error(values, slope, 1.0, steps)
    return Comparison(error) if kink is None else Comparison(kink, True)


def random_states(plain, knee, left, count, seed=0):
    """Yield random states near recorded frames, with other loads and released coordinates."""
    rng = np.random.default_rng(seed + left)
    body = whole_body(knee, left=True) if left else None
    mirrored = [
        replace(one, proximal=moved(one.proximal, True), distal=moved(one.distal, True))
        for one in knee.ligaments
    ]
    _, motion, ground = plain
    for k in range(count):
        frame = int(rng.integers(15, 98))
        move = rng.uniform(-1.0, 1.0, 6) * [5e-4, 0.0, 5e-4, 3e-3, 5e-3, 0.03]
        q = knee.bridge.configuration(motion.q[frame], knee_pose(motion.coordinates[frame] + move))
        fext = pin.StdVec_Force([rng.uniform(0.8, 1.2) * force for force in ground[frame]])
        yield State(
            body.knee if left else knee,
            knee,
            body.state if left else lambda *now: now,
            mirrored if left else knee.ligaments,
            CHOICES[k % len(CHOICES)],
            q,
            motion.v[frame],
            motion.a[frame],
            fext,
        )


def comparisons(plain, knee, left, count):
    """Yield parameter -> comparison in random states that have an equilibrium.

    Where the force of a contact jumps from facet to facet, there may be none to rounding errors.
    """
    rng = np.random.default_rng(10 + left)
    for state in random_states(plain, knee, left, count):
        solved = state.equilibrium(derivatives=True)
        if not solved.failed:
            yield {
                name: compared(state, name, *pair) for name, *pair in directions(state, solved, rng)
            }
