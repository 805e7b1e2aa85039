"""One frame of a knee: loads, contact and equilibrium together.

- `coupled = False`: the equations give the superior-inferior contact force, with contact points on
  the undeformed meshes. The contact model presses with that load at the recorded rotation.
- `coupled = True`: the resultant of each condyle then replaces point and normal in the equations.
  Equations and press are repeated until load and centres of pressure converge.
- `released = (...)`: these coordinates are found by equilibrium of contact, ligaments and muscle
  line (`tkamb.knee.released`). The equations then use the resultants at that pose.

All quantities are those of a right knee, in the insert frame.
"""

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import ComputationError, TkambError
from tkamb.geometry.frames import Array, Index, Mask, knee_pose
from tkamb.knee.equations import KneeGeometry, SolvedLoads, solve_knee, unsolved
from tkamb.knee.instant import NO_CONTACT, ContactPoints, Instant
from tkamb.knee.unknowns import CondylePoint
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.cam_post import CamPost, PostContact
    from tkamb.contact.result import ContactResult, WarmStart
    from tkamb.geometry.adjustment import Adjustment, AdjustmentSettings
    from tkamb.geometry.surface import Surface
    from tkamb.knee.adjustment import AdjustmentEffect
    from tkamb.knee.button import ButtonPress
    from tkamb.knee.contact import KneeContact
    from tkamb.knee.found_patella import FoundPatella
    from tkamb.knee.knee import Knee
    from tkamb.knee.released import KneeEquilibrium, ReleasedKnee
    from tkamb.knee.starts import InitialPoses

NAN = float("nan")


@dataclass(frozen=True)
class CouplingSettings:
    """Convergence of the coupling of body and contact in one frame."""

    force_tolerance: float = 0.1
    """N: largest change of the load in a converged iteration. No contact model
    resolves a ten-thousandth of a body weight."""
    point_tolerance: float = 1e-6
    """m: largest travel of a centre of pressure in a converged iteration. A smaller travel
    does not change a force."""
    max_iterations: int = 20
    """1: iterations after which a frame fails. Not studied."""
    stiffness_error: float = 0.02
    """1: relative error of the knee's compliance to muscles above which a released frame gets a
    flag. Not studied."""
    post_overlap: float = 0.5 * MILLIMETRE
    """m: overlap of cam and post at a recorded pose above which a flag is set. It is
    the usual error of a position from fluoroscopy."""


COUPLING = CouplingSettings()


@dataclass(frozen=True, eq=False)
class FrameStart:
    """Initial guess for the next frame; None: there is none.

    Args:
        contact: warm start of the contact model; None: there is none.
        equilibrium: equilibrium of the released coordinates; None: none are released, or the frame
            failed.
        button: warm start of the button's contact; None: there is none.
        patella: coordinates (6,) of the patella as a body.
    """

    contact: "WarmStart | None" = None
    equilibrium: "KneeEquilibrium | None" = None
    button: "WarmStart | None" = None
    patella: Array | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """Loads and contact of a knee in one frame.

    Args:
        geometry: geometry in the equations of motion.
        seconds: computing time of kinematics and equations, s.
        query_seconds: computing time of the closest points on the meshes, s.
        adjustment: femoral adjustment, after its check if there is a contact; None: not requested,
            or impossible.
        effect: change of the forces by the adjustment; None also without a solution at the recorded
            pose.
        contact: the contact; None: not modelled, or it could not be computed.
        problem: reason why a modelled contact is missing; else empty.
        contact_seconds: computing time of the contact, s.
        iterations: iterations between loads and contact; 0: not coupled.
        load_change: change of the load in the last iteration, N.
        point_change: change of the centres of pressure in the last iteration, m.
        equilibrium: result of the search for released coordinates; None: none are released.
        sensitivity: change of the medial force with adduction (`split_sensitivity`), N/rad; NaN:
            adduction is released, or there is one condyle.
        start: warm start of the next frame's contact; None: there is none.
        medial: whether each map point lies under the medial condyle, (n,); None: there is no
            contact.
        triangles: triangles of the map, (k, 3); None: there is no contact.
        post: contact of cam and post; None: not modelled.
        button: the button pressed on the femoral component; None: not modelled, or the frame
            failed.
        patella: the patella in six degrees of freedom; None: not modelled, or the frame failed.
    """

    geometry: KneeGeometry
    loads: SolvedLoads
    seconds: float = 0.0
    query_seconds: float = 0.0
    adjustment: "Adjustment | None" = None
    effect: "AdjustmentEffect | None" = None
    contact: "ContactResult | None" = None
    problem: str = ""
    flags: tuple[str, ...] = ()
    contact_seconds: float = 0.0
    iterations: int = 0
    load_change: float = NAN
    point_change: float = NAN
    equilibrium: "KneeEquilibrium | None" = None
    sensitivity: float = NAN
    start: "WarmStart | None" = None
    medial: Mask | None = None
    triangles: Index | None = None
    post: "PostContact | None" = None
    button: "ButtonPress | None" = None
    patella: "FoundPatella | None" = None

    @property
    def next(self) -> FrameStart:
        """The initial guess of the next frame."""
        button = None if self.button is None else self.button.start
        found = self.patella is not None and not self.patella.problem
        patella = self.patella.balance.coordinates if self.patella and found else None
        return FrameStart(self.start, None if self.problem else self.equilibrium, button, patella)

    @property
    def pressed(self) -> bool:
        """Whether the contact is modelled. It may have failed."""
        return self.contact is not None or bool(self.problem)

    @property
    def failures(self) -> list[str]:
        """Reasons of a failed frame; empty if the frame has forces."""
        return list(self.loads.problems) or ([self.problem] if self.problem else [])

    def area_above(self, side: str, pressure: float) -> float:
        """Return the share of a condyle's contact area above a pressure (Pa), 1 at most.

        The pressure is linear between the map points, see `tkamb.contact.area.area_above`.
        """
        condyle = getattr(self.contact, side, None)
        if self.contact is None or condyle is None:
            return NAN
        from tkamb.contact.area import area_above

        assert self.medial is not None and self.triangles is not None
        under_condyle = self.medial if side == "medial" else ~self.medial
        condyle_pressure = np.where(under_condyle, self.contact.pressure, 0.0)
        above = area_above(self.contact.points, self.triangles, condyle_pressure, pressure)
        return min(above / condyle.area, 1.0)


@dataclass(frozen=True, eq=False)
class FrameMethod:
    """How the frames of a knee are computed.

    The contact is prepared at its first use.

    Args:
        knee: a knee of a right leg.
        coupled: whether the contact's resultants replace the contact points in the equations.
        adjust: settings of the femoral adjustment; None: no adjustment.
        split_sensitivity: whether to compute the change of the medial force with adduction. A
            contact model without a tangent needs one more press for it.
        post: surface of the insert's post, insert frame; None: not modelled.
        ready_cam: `cam` of another method with the same contact model, perhaps with another
            material; None: prepared here.
    """

    knee: "Knee"
    coupled: bool = False
    released: tuple[str, ...] = ()
    adjust: "AdjustmentSettings | None" = None
    split_sensitivity: bool = True
    post: "Surface | None" = None
    ready_cam: "CamPost | None" = None

    def of(self, knee: "Knee") -> "FrameMethod":
        """Return the same method for another knee."""
        # The prepared cam belongs to the contact model of this knee.
        return replace(self, knee=knee, ready_cam=None)

    def prepare(self) -> None:
        """Prepare the contacts, so that their errors occur here.

        Raises:
            InputError: the contact model cannot use the meshes.
        """
        if self.knee.contact is not None:
            self._state  # noqa: B018
            self.cam  # noqa: B018
        if self.knee.button_contact is not None:
            self.knee.button_contact.contact.state  # noqa: B018

    @property
    def _contact(self) -> "KneeContact":
        contact = self.knee.contact
        assert contact is not None
        return contact

    @cached_property
    def _state(self) -> Any:
        return self._contact.state

    @cached_property
    def cam(self) -> "CamPost | None":
        """Prepared contact of cam and post; None: not modelled."""
        if self.post is None:
            return None
        from tkamb.contact.cam_post import CamPost

        contact, ready = self._contact, self.ready_cam
        material, pair = self._state.pair.material, contact.pair
        if ready is not None:
            return ready if ready.material == material else ready.of_material(material)
        return CamPost(contact.model, pair.femoral, self.post, pair.split, material)

    @cached_property
    def _probe(self) -> Any:
        return self._contact.model.probe(self._state)

    @cached_property
    def search(self) -> "ReleasedKnee":
        """Search for the released coordinates."""
        from tkamb.knee.released import ReleasedKnee

        probe = self._probe if self.cam is None else self.cam.probe_with(self._probe)
        return ReleasedKnee(probe, self.released)

    @cached_property
    def starts(self) -> "InitialPoses":
        """Initial guesses of the search for the released coordinates."""
        from tkamb.knee.starts import InitialPoses

        return InitialPoses(self.search, self._state.pair, self.cam)

    def frame(self, instant: Instant, before: Sequence[FrameStart] = ()) -> Frame:
        """Return loads and contacts at an instant.

        Args:
            before: starts of the earlier frames.
        """
        last = before[-1] if before else FrameStart()
        instant = replace(instant, patella_start=last.patella)
        frame, button = self._knee_frame(instant, before), self.knee.button_contact
        if button is None or frame.failures or frame.geometry.extensor is None:
            return frame
        from tkamb.knee.button import ButtonPress

        state, extensor = frame.geometry.state, frame.geometry.extensor
        if extensor.released is not None:
            found = extensor.released.found
            return replace(frame, button=found.press if found else None, patella=found)
        if self.knee.patella is not None:
            problem = "patella: no tension of the quadriceps pulls it"
            press = ButtonPress(np.full(3, NAN), np.full((4, 4), NAN), problem=problem)
            return replace(frame, button=press)
        force = frame.loads.values.get("patellofemoral", NAN) * extensor.contact_normal
        femur, patella = state.pose("femur"), state.pose("patella")
        return replace(frame, button=button.pressed(femur, patella, force, last.button))

    def _knee_frame(self, instant: Instant, before: Sequence[FrameStart]) -> Frame:
        if self.knee.contact is None:
            return self.loads(instant)
        if self.released:
            frame = self._release(instant, before)
        else:
            frame = self._press_recorded(instant, before)
        if frame.contact is None or frame.loads.problems or self._contact.pair.split is None:
            return frame
        if not self.split_sensitivity or "adduction" in self.released:
            return frame
        from tkamb.knee.adjustment import split_sensitivity, split_tangent

        began = clock.perf_counter()
        if self._probe.exact:
            sensitivity = split_tangent(self._probe, frame.contact)
        else:
            sensitivity = split_sensitivity(self._probe, frame.contact, frame.start)
        seconds = frame.contact_seconds + clock.perf_counter() - began
        return replace(frame, sensitivity=sensitivity, contact_seconds=seconds)

    def loads(self, instant: Instant, adjustment: "Adjustment | None" = None) -> Frame:
        """Return the loads by the equations alone; NaN without a solution.

        Args:
            adjustment: femoral adjustment; None: computed if the method has one.
        """
        began, problems = clock.perf_counter(), tuple[str, ...]()
        recorded_pose = knee_pose(instant.coordinates)
        if adjustment is None:
            adjustment, problems = self._adjust(recorded_pose)
        pose = adjustment.pose if adjustment else recorded_pose
        points = NO_CONTACT if problems else self._contact_points(instant, pose)
        recorded = self._contact_points(instant, recorded_pose) if adjustment else None
        query_end = clock.perf_counter()
        geometry = instant.geometry()
        problems += points.problems + geometry.problems
        geometry = replace(
            geometry, condyles=points.condyles, lifted=points.lifted, problems=problems
        )
        geometry, loads = instant.solved(geometry)
        end = clock.perf_counter()
        effect = _effect(geometry, loads, recorded, instant.friction) if recorded else None
        return Frame(geometry, loads, end - query_end, query_end - began, adjustment, effect)

    def _adjust(self, pose: Array) -> "tuple[Adjustment | None, tuple[str, ...]]":
        """Return the femoral adjustment, if the method has one, and reasons for its failure."""
        if self.knee.contact is None or self.adjust is None:
            return None, ()
        from tkamb.geometry.adjustment import adjust

        try:
            return adjust(self.knee._query, pose, self.adjust), ()
        except TkambError as error:
            return None, (error.what,)

    def _contact_points(self, instant: Instant, pose: Array) -> ContactPoints:
        if self.knee.contact is None:
            return NO_CONTACT
        return instant.contact_points(self.knee._query, pose)

    def _press_recorded(self, instant: Instant, before: Sequence[FrameStart]) -> Frame:
        from tkamb.geometry.threads import both

        start = before[-1].contact if before else None
        pose, pair = knee_pose(instant.coordinates), self._state.pair
        # The press needs the pose of first touch: it is computed during the body's equations.
        body, _ = both(lambda: self.loads(instant), lambda: pair.touch_at(pose))
        frame = self._pressed(body, pose, start)
        if frame.adjustment and frame.adjustment.restored:
            # The recorded rotation has other contact points, and therefore another load.
            body = self.loads(instant, frame.adjustment)
            frame = self._pressed(body, pose, frame.start)
        if not self.coupled and self.cam is None:
            return frame
        return self._couple(instant, body, frame)

    def _pressed(self, body: Frame, pose: Array, start: "WarmStart | None") -> Frame:
        """The rotation is the recorded one or, with an adjustment, the adjusted one.

        Args:
            body: loads by the equations, with the adjustment before its check.
            pose: recorded pose_femoral_in_insert, (4, 4).
        """
        load = float(body.loads.contact_force[1])
        if not np.isfinite(load):
            return replace(body, problem="no load from the equations")
        if load <= 0:
            return replace(body, problem="no compressive load")
        began, adjustment = clock.perf_counter(), body.adjustment
        model, state = self._contact.model, self._state
        if adjustment is None:
            result, start = model.press_from(state, load, pose, start)
        else:
            from tkamb.knee.adjustment import press_adjusted

            result, adjustment, start = press_adjusted(
                model, state, load, adjustment, self.knee._query, start
            )
        seconds = clock.perf_counter() - began
        body = replace(body, adjustment=adjustment, contact_seconds=seconds)
        return self._touched(body, result, start)

    def _couple(self, instant: Instant, body: Frame, frame: Frame) -> Frame:
        """Iterate between equations and contact, until both converge.

        The resultants of the contact (if coupled) and the post force act on the body. Each press
        checks the adjustment anew.

        Args:
            body: loads by the equations, with the adjustment before its check.
        """
        seconds, place = frame.contact_seconds, instant.coordinates
        for iteration in range(1, COUPLING.max_iterations + 1):
            if frame.contact is None:
                return frame
            load, points = body.loads.contact_force[1], _points(body)
            result = self._resultants(instant, frame.contact) if self.coupled else {}
            post = self._post_contact(frame.contact.pose)
            if post is not None and post.problem:
                return replace(_without_contact(frame, post.problem), post=post)
            pushed = instant.post_loads(place, post.load if post else None)
            geometry = replace(body.geometry, condyles=body.geometry.condyles | result, post=pushed)
            geometry, loads = instant.solved(geometry)
            body = replace(body, geometry=geometry, loads=loads)
            # The adjustment of the equations, not the checked one: each press decides anew.
            frame = self._pressed(body, knee_pose(place), frame.start)
            seconds += frame.contact_seconds
            change = abs(float(body.loads.contact_force[1] - load))
            travel = _travel(points, _points(body))
            frame = replace(
                frame,
                contact_seconds=seconds,
                iterations=iteration,
                load_change=change,
                point_change=travel if self.coupled else NAN,
                post=post,
            )
            if change < COUPLING.force_tolerance and travel < COUPLING.point_tolerance:
                return frame
        return _without_contact(frame, "the iteration of body and contact does not converge")

    def _release(self, instant: Instant, before: Sequence[FrameStart]) -> Frame:
        """The initial guess extrapolates the last three equilibria of `before`."""
        began = clock.perf_counter()
        # A frame that failed has no equilibrium: the guess skips it.
        good = [each for each in before if each.equilibrium][-3:]
        # With a held coordinate, residual forces act between both condyles, loaded or not.
        points: dict[str, Array] = {}
        if len(self.search.released) < 5:
            points = self.knee._nearest_points(instant.coordinates)
        try:
            knee = self.starts.equilibrium(
                instant, [each.equilibrium for each in good if each.equilibrium], points
            )
        except ComputationError as error:
            return _without_contact(self.loads(instant), error.what)
        frame = Frame(
            knee.geometry,
            unsolved([knee.problem]),
            problem=knee.problem,
            iterations=knee.passes,
            load_change=knee.change,
            equilibrium=knee,
        )
        if not knee.problem:
            frame = self._in_equilibrium(frame, knee, good[-1].contact if good else None)
        frame = replace(frame, contact_seconds=clock.perf_counter() - began)
        began = clock.perf_counter()
        if frame.contact is None:
            frame = replace(frame, loads=unsolved([frame.problem]))
        else:
            geometry = self._equilibrium_geometry(instant, knee, frame.contact, points)
            geometry, loads = instant.solved_with_muscles(geometry)
            frame = replace(frame, geometry=geometry, loads=loads)
        frame = replace(frame, seconds=clock.perf_counter() - began)
        if frame.loads.problems:
            return replace(frame, contact=None, problem=frame.loads.problems[0])
        return frame

    def _in_equilibrium(
        self, frame: Frame, knee: "KneeEquilibrium", start: "WarmStart | None"
    ) -> Frame:
        from tkamb.contact.pressing import within_insert
        from tkamb.geometry.threads import both

        pose, model, state = knee_pose(knee.coordinates), self._contact.model, self._state
        # `within_insert` needs the pose of first touch: it is computed at the same time.
        (result, next_start), _ = both(
            lambda: model.evaluate_from(state, pose, start), lambda: state.pair.touch_at(pose)
        )
        frame = self._touched(frame, within_insert(state, result), next_start)
        flags = (*frame.flags, *_equilibrium_flags(knee))
        return replace(frame, flags=flags, post=self._post_contact(result.pose))

    def _equilibrium_geometry(
        self,
        instant: Instant,
        knee: "KneeEquilibrium",
        contact: "ContactResult",
        points: dict[str, Array],
    ) -> KneeGeometry:
        """Return the geometry with the resultants of condyles and post."""
        from tkamb.contact.model import condyle_wrenches

        condyles, place = condyle_wrenches(contact, self._contact.pair.split), knee.coordinates
        return replace(
            instant.touching(knee.geometry, place, condyles, points),
            post=instant.post_loads(place, knee.contact.post),
        )

    def _resultants(self, instant: Instant, result: "ContactResult") -> dict[str, CondylePoint]:
        from tkamb.contact.model import condyle_wrenches

        condyles = condyle_wrenches(result, self._contact.pair.split)
        return instant.resultants(instant.coordinates, condyles)

    def _post_contact(self, pose: Array) -> "PostContact | None":
        """Return the contact of cam and post at a pose (4, 4); None: not modelled.

        The result has a flag if cam and post overlap at a recorded AP position.
        """
        if self.cam is None:
            return None
        post = self.cam.at(pose)
        # With AP released, equilibrium determines the overlap.
        if "ap" in self.released or post.problem or not post.gap < -COUPLING.post_overlap:
            return post
        flag = (
            f"cam and post: they overlap by {-post.gap / MILLIMETRE:.1f} mm at the recorded "
            f"position, with a force of {np.linalg.norm(post.force):.0f} N: add 'ap' to [contact] "
            "released"
        )
        return replace(post, flags=(*post.flags, flag))

    def _touched(self, frame: Frame, result: "ContactResult", start: "WarmStart") -> Frame:
        from tkamb.contact.result import ContactStatus, medial_points

        if result.status is not ContactStatus.OK:
            # The flags of the model say why it failed.
            reason = f"contact {result.status.value.replace('_', ' ')}"
            return replace(frame, problem="; ".join((reason, *result.flags)))
        state = self._state
        return replace(
            frame,
            contact=result,
            flags=result.flags,
            start=start,
            medial=medial_points(state.points, result.pose, self._contact.pair.split),
            triangles=state.triangles,
        )


def _effect(
    geometry: KneeGeometry, loads: SolvedLoads, recorded: ContactPoints, friction: float
) -> "AdjustmentEffect | None":
    """Return None if one of the two poses has no solution."""
    if loads.problems or recorded.problems:
        return None
    from tkamb.knee.adjustment import adjustment_effect

    recorded_geometry = replace(geometry, condyles=recorded.condyles, lifted=recorded.lifted)
    before = solve_knee(recorded_geometry, friction)
    if before.problems:
        return None
    return adjustment_effect(loads, before, geometry.condyles, recorded.condyles)


def _without_contact(frame: Frame, problem: str) -> Frame:
    return replace(frame, loads=unsolved([problem]), contact=None, problem=problem)


def _equilibrium_flags(knee: "KneeEquilibrium") -> tuple[str, ...]:
    """Return flags for a second equilibrium and an inaccurate compliance."""
    second = (knee.second,) if knee.second else ()
    if knee.compliance_error <= COUPLING.stiffness_error:
        return second
    return (
        *second,
        "the response of the knee's coordinates to the muscles has not converged (relative error "
        f"{100 * knee.compliance_error:.0f} %): with other initial guesses such frames differed by "
        "up to 3 % in the total force and 60 N in the force of one condyle",
    )


def _points(frame: Frame) -> dict[str, Array]:
    return {side: condyle.point for side, condyle in frame.geometry.condyles.items()}


def _travel(before: dict[str, Array], after: dict[str, Array]) -> float:
    """Return the largest distance, m, between matching points."""
    return max(float(np.linalg.norm(after[side] - before[side])) for side in after)
