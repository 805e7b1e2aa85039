"""Coupling of the rigid-body equations and the contact model in each frame.

- `coupling = "none"`: the equations give the superior-inferior contact force, with contact points
  on the undeformed meshes. The contact model presses with that load at the recorded rotation.
- `coupling = "points"`: the resultant of each condyle then replaces point and normal in the
  equations. Equations and press are repeated until load and centres of pressure converge.
- `released = [...]`: these coordinates are found by equilibrium of contact, ligaments and muscle
  line (`tkamb.knee.released`). The equations then use the resultants at that pose.

`contact_arrays` returns the arrays of a frame's contact that the results folder stores. A resumed
run takes its warm start from them (`recalled`). They do not include the displacements of the
lattice: a resumed run differs from a single one within the tolerance of the solver.
"""

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.contact.model import ProbedContact, condyle_wrenches
from tkamb.contact.pressing import within_insert
from tkamb.contact.result import ContactResult, ContactStatus, WarmStart, medial_points
from tkamb.errors import ComputationError
from tkamb.geometry.adjustment import Adjustment
from tkamb.geometry.frames import SIDES, Array, knee_pose
from tkamb.geometry.threads import both
from tkamb.knee.adjustment import press_adjusted, split_sensitivity, split_tangent
from tkamb.knee.balance import Balance, BalanceStatus
from tkamb.knee.contact_points import CondylePoint
from tkamb.knee.equations import solve_knee, unsolved
from tkamb.knee.frame_contact import FrameContact, post_contact
from tkamb.knee.instant import Instant
from tkamb.run.mechanics import FrameLoads, Mechanics
from tkamb.run.recorder import CONTACT_PLACES

if TYPE_CHECKING:
    from tkamb.contact.cam_post import CamPost
    from tkamb.knee.equations import KneeGeometry
    from tkamb.knee.released import KneeEquilibrium


NAN = float("nan")


@dataclass(frozen=True)
class CouplingSettings:
    """Convergence of the coupling of body and contact in one frame."""

    force_tolerance: float = 0.1
    """N: largest change of the load in a converged iteration. Chosen because no contact model
    resolves a ten-thousandth of a body weight."""
    point_tolerance: float = 1e-6
    """m: largest travel of a centre of pressure in a converged iteration. A smaller travel
    does not change a force."""
    max_iterations: int = 20
    """1: iterations after which a frame fails. Chosen because frames that converge need fewer."""
    stiffness_error: float = 0.02
    """1: relative error of the knee's compliance to muscles above which a released frame gets a
    flag. Chosen because the search converges with such an error."""


COUPLING = CouplingSettings()


class ContactSide:
    """The contact model of a knee, coupled with the rigid-body equations.

    Args:
        mechanics: rigid-body mechanics of a knee with contact.
        coupled: whether the contact's resultants replace the contact points in the equations.
        released: names of the released coordinates.
        post: cam and post; None: not modelled.
        sensitivity: whether to compute the change of the medial force with adduction. A contact
            model without a tangent needs one more press for it.
        prepare_seconds: computing time of the preparation of the contact model, s.

    Attributes:
        model: contact model.
        state: state that the contact model has prepared.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        coupled: bool = False,
        released: Sequence[str] = (),
        post: "CamPost | None" = None,
        sensitivity: bool = True,
        prepare_seconds: float = 0.0,
    ) -> None:
        contact = mechanics.knee.contact
        assert contact is not None
        self.mechanics, self.post, self.prepare_seconds = mechanics, post, prepare_seconds
        self.model, self.state, self._coupled = contact.model, contact.state, coupled
        self._split, self._names = contact.pair.split, tuple(released)
        self._sensitivity = sensitivity and "adduction" not in released
        self._probe = self.model.probe(self.state)
        self.released = None
        if released:
            from tkamb.knee.released import ReleasedKnee
            from tkamb.knee.starts import InitialPoses

            probe = self._probe if post is None else post.probe_with(self._probe)
            self.released = ReleasedKnee(probe, released)
            self.starts = InitialPoses(self.released, self.state.pair, post)

    def frame(self, k: int, before: Sequence[FrameContact] = ()) -> tuple[FrameLoads, FrameContact]:
        """Return loads and contact of frame k, coupled as the scene states.

        Args:
            k: index of the frame.
            before: contacts of the earlier frames, for warm start and initial guess.
        """
        if self.released is None:
            body, contact = self._press_recorded(k, before)
        else:
            body, contact = self._release(k, before)
        if contact.result is None or body.loads.problems or self._split is None:
            return body, contact
        if not self._sensitivity:
            return body, contact
        start = clock.perf_counter()
        if self._probe.exact:
            sensitivity = split_tangent(self._probe, contact.result)
        else:
            sensitivity = split_sensitivity(self._probe, contact.result, contact.start)
        seconds = contact.seconds + clock.perf_counter() - start
        return body, replace(contact, sensitivity=sensitivity, seconds=seconds)

    def _press_recorded(
        self, k: int, before: Sequence[FrameContact]
    ) -> tuple[FrameLoads, FrameContact]:
        """Return loads and contact at the recorded rotation."""
        begin, pose = before[-1].start if before else None, self.mechanics.poses[k]
        # The press needs the pose of first touch: it is computed during the body's equations.
        body, _ = both(lambda: self.mechanics.frame(k), lambda: self.state.pair.touch_at(pose))
        contact = self.press_load(body, self.mechanics.poses[k], begin)
        if contact.adjustment and contact.adjustment.restored:
            body = self.mechanics.frame(k, contact.adjustment)
            contact = self.press_load(body, self.mechanics.poses[k], contact.start)
        if not self._coupled and self.post is None:
            return body, contact
        return self._couple(k, body, contact)

    def press_load(self, body: FrameLoads, pose: Array, begin: WarmStart | None) -> FrameContact:
        """Return the contact under the load of the body's equations.

        The rotation is the recorded one or, with an adjustment, the adjusted one.

        Args:
            body: loads of the frame by the equations.
            pose: recorded pose_femoral_in_insert, (4, 4).
            begin: warm start of the previous frame; None: no warm start.
        """
        load = float(body.loads.contact_force[1])
        if not np.isfinite(load):
            return self.failed("no load from the equations")
        if load <= 0:
            return self.failed("no compressive load")
        began = clock.perf_counter()
        adjustment, query = body.adjustment, self.mechanics.query
        if adjustment is None or query is None:
            result, start = self.model.press_from(self.state, load, pose, begin)
        else:
            result, adjustment, start = press_adjusted(
                self.model, self.state, load, adjustment, query, begin
            )
        seconds = clock.perf_counter() - began
        return self._contact(result, start, adjustment, seconds)

    def _couple(
        self, k: int, body: FrameLoads, contact: FrameContact
    ) -> tuple[FrameLoads, FrameContact]:
        """Iterate between equations and contact; return loads and contact.

        The resultants of the contact (if coupled) and the post force act on the body.
        """
        seconds, instant = contact.seconds, self.mechanics.instant(k)
        place, coupled = instant.coordinates, self._coupled
        for iteration in range(1, COUPLING.max_iterations + 1):
            if contact.result is None:
                return body, contact
            load, points = body.loads.contact_force[1], _points(body)
            result = self._resultants(instant, contact.result) if coupled else {}
            post = post_contact(self.post, contact.result.pose, self._names)
            if post is not None and post.problem:
                return replace(body, loads=unsolved([post.problem])), replace(
                    contact, result=None, problem=post.problem, post=post
                )
            pushed = instant.post_loads(place, post.load if post else None)
            geometry = replace(body.geometry, condyles=body.geometry.condyles | result, post=pushed)
            geometry, loads = instant.solved(geometry)
            body = replace(body, geometry=geometry, loads=loads)
            contact = self.press_load(body, self.mechanics.poses[k], contact.start)
            seconds += contact.seconds
            change = abs(float(body.loads.contact_force[1] - load))
            travel = _travel(points, _points(body))
            contact = replace(
                contact,
                seconds=seconds,
                iterations=iteration,
                load_change=change,
                point_change=travel if coupled else NAN,
                post=post,
            )
            if change < COUPLING.force_tolerance and travel < COUPLING.point_tolerance:
                return body, contact
        problem = "the iteration of body and contact does not converge"
        return replace(body, loads=unsolved([problem])), replace(
            contact, result=None, problem=problem
        )

    def _release(self, k: int, before: Sequence[FrameContact]) -> tuple[FrameLoads, FrameContact]:
        """Return loads and contact with the released coordinates in equilibrium.

        Args:
            k: index of the frame.
            before: contacts of the earlier frames. The initial guess extrapolates the last three
                equilibria.
        """
        released, began, mechanics = self.released, clock.perf_counter(), self.mechanics
        assert released is not None
        instant = mechanics.instant(k)
        good = [contact for contact in before if contact.equilibrium and not contact.problem][-3:]
        begin = good[-1].start if good else None
        points = {}
        if len(released.released) < 5:
            points = mechanics.knee._nearest_points(instant.coordinates)
        try:
            knee = self.starts.equilibrium(
                instant, [c.equilibrium for c in good if c.equilibrium], points
            )
        except ComputationError as error:
            contact = self.failed(error.what)
            body = mechanics.frame(k)
            return replace(body, loads=unsolved([contact.problem])), contact
        result, contact = None, self.failed(knee.problem)
        if not knee.problem:
            pose, pair = knee_pose(knee.coordinates), self.state.pair
            # `within_insert` needs the pose of first touch: it is computed at the same time.
            (result, start), _ = both(
                lambda: self.model.evaluate_from(self.state, pose, begin),
                lambda: pair.touch_at(pose),
            )
            result = within_insert(self.state, result)
            contact = self._contact(result, start, None, 0.0)
            flags = (*contact.flags, *_equilibrium_flags(knee))
            post = post_contact(self.post, result.pose, self._names)
            contact = replace(contact, flags=flags, post=post)
        contact = replace(
            contact,
            seconds=clock.perf_counter() - began,
            iterations=knee.passes,
            load_change=knee.change,
            equilibrium=knee,
        )
        body = self._equilibrium_loads(instant, knee, contact, points)
        if body.loads.problems:
            return body, replace(contact, result=None, problem=body.loads.problems[0])
        return body, contact

    def _equilibrium_loads(
        self,
        instant: Instant,
        knee: "KneeEquilibrium",
        contact: FrameContact,
        points: dict[str, Array],
    ) -> FrameLoads:
        start, geometry = clock.perf_counter(), knee.geometry
        if contact.result is None:
            loads = unsolved([contact.problem])
        else:
            condyles, place = condyle_wrenches(contact.result, self._split), knee.coordinates
            geometry = replace(
                instant.touching(geometry, place, condyles, points),
                post=instant.post_loads(place, knee.contact.post),
            )
            loads = solve_knee(geometry, instant.friction)
        seconds = clock.perf_counter() - start
        return FrameLoads(geometry, loads, None, 0.0, seconds)

    def _resultants(self, instant: Instant, result: ContactResult) -> dict[str, CondylePoint]:
        """Return the contact's resultants as the contact points of the equations."""
        condyles = condyle_wrenches(result, self._split)
        return instant.resultants(instant.coordinates, condyles)

    def _contact(
        self,
        result: ContactResult,
        start: WarmStart,
        adjustment: Adjustment | None,
        seconds: float,
    ) -> FrameContact:
        medial = medial_points(self.state.points, result.pose, self._split)
        if result.status is not ContactStatus.OK:
            reason = f"contact {result.status.value.replace('_', ' ')}"
            words = "; ".join((reason, *result.flags))
            return FrameContact(None, medial, adjustment, seconds, words, ())
        return FrameContact(
            result, medial, adjustment, seconds, "", result.flags,
            start=start, triangles=self.state.triangles,
        )  # fmt: skip

    def failed(self, problem: str) -> FrameContact:
        """Return a contact without a result, with the reason."""
        none = np.zeros(len(self.state.points), bool)
        return FrameContact(None, none, None, 0.0, problem, ())


def _equilibrium_flags(knee: "KneeEquilibrium") -> tuple[str, ...]:
    """Return the flags of an equilibrium: a second equilibrium, an inaccurate compliance."""
    second = (knee.second,) if knee.second else ()
    if knee.compliance_error <= COUPLING.stiffness_error:
        return second
    return (
        *second,
        "the response of the knee's coordinates to the muscles has not converged (relative error "
        f"{100 * knee.compliance_error:.0f} %): with other initial guesses such frames differed by "
        "up to 3 % in the total force and 60 N in the force of one condyle",
    )


def _points(body: FrameLoads) -> dict[str, Array]:
    return {side: condyle.point for side, condyle in body.geometry.condyles.items()}


def _travel(before: dict[str, Array], after: dict[str, Array]) -> float:
    """Return the largest distance, m, by which a contact point has moved."""
    return max(float(np.linalg.norm(after[side] - before[side])) for side in after)


RESULT_ARRAYS = ("pose", "pressure", "gap", "nodal_force")
"""Arrays of a contact result that pressure maps and warm starts of resumed runs need."""


def contact_arrays(
    contact: FrameContact | None, geometry: "KneeGeometry"
) -> dict[str, Array] | None:
    """Return the arrays of a frame's contact to store, by name; None without a result.

    Args:
        contact: contact of the frame.
        geometry: geometry of the frame in the equations.
    """
    if contact is None or contact.result is None:
        return None
    result, knee = contact.result, contact.equilibrium
    arrays = {name: np.asarray(getattr(result, name), float) for name in RESULT_ARRAYS}
    points, normals = np.full((2, 3, 3), np.nan)
    for side, condyle in geometry.condyles.items():
        points[SIDES.index(side)], normals[SIDES.index(side)] = condyle.point, condyle.normal
    if geometry.extensor is not None:
        points[2] = geometry.extensor.contact_point
        normals[2] = geometry.extensor.contact_normal
    arrays |= zip(CONTACT_PLACES, (points, normals), strict=True)
    if knee is not None:
        arrays["equilibrium_coordinates"] = knee.coordinates
        arrays["equilibrium_force"] = knee.balance.force
        arrays["equilibrium_stiffness"] = knee.balance.stiffness
        if knee.patella is not None:
            arrays["equilibrium_patella"] = knee.patella.coordinates
    return arrays


def recalled(
    side: ContactSide, mechanics: Mechanics, frame: int, arrays: Mapping[str, Array] | None
) -> FrameContact:
    """Return a contact with the warm start of a stored frame and without a result."""
    none = np.zeros(len(side.state.points), bool)
    if arrays is None:
        return FrameContact(None, none, None, 0.0, "not recalled", ())
    knee = _equilibrium(mechanics, frame, arrays) if "equilibrium_coordinates" in arrays else None
    state = side.state
    start = WarmStart(state.pair, arrays["pose"], state.points, arrays["pressure"], arrays["gap"])
    return FrameContact(None, none, None, 0.0, "", (), equilibrium=knee, start=start)


def _equilibrium(
    mechanics: Mechanics, frame: int, arrays: Mapping[str, Array]
) -> "KneeEquilibrium":
    from tkamb.knee.released import KneeEquilibrium

    patella = None
    if mechanics.extensor is not None and "equilibrium_patella" in arrays:
        state = mechanics.extensor.states[frame]
        patella = replace(state, coordinates=arrays["equilibrium_patella"])
    place, nan = arrays["equilibrium_coordinates"], float("nan")
    return KneeEquilibrium(
        coordinates=place,
        geometry=mechanics.geometry(frame, place, patella),
        patella=patella,
        contact=ProbedContact({}),
        balance=Balance(
            coordinates=place,
            force=arrays["equilibrium_force"],
            stiffness=arrays["equilibrium_stiffness"],
            status=BalanceStatus.OK,
            steps=0,
            trials=0,
            smallest_stiffness=nan,
            work=(),
        ),
        passes=0,
        trials=0,
        change=nan,
        problem="",
    )
