"""Body and contact together: the only file where both meet in the computation.

- `coupling = "none"`: the body's equations give the superior-inferior contact force, with
  contact points from the undeformed meshes, and the contact model presses that load in at
  the recorded rotation.
- `coupling = "points"`: each condyle's resultant then takes the place of point and normal in
  the equations, and so on until load and centres of pressure change no more.
- `released = [...]`: these coordinates find their own equilibrium under contact, ligaments
  and muscle line (`tkamb.knee.equilibrium.released`); the equations then use the resultants found.
"""

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.pressing import within_insert
from tkamb.contact.probe import condyle_wrenches
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactResult, ContactStatus, medial_points
from tkamb.contact.warm_start import WarmStart
from tkamb.errors import ComputationError
from tkamb.geometry.adjustment import Adjustment
from tkamb.geometry.frames import Array, knee_pose
from tkamb.geometry.threads import both
from tkamb.io.given_material import given_material, material_as_json
from tkamb.io.scene import Scene
from tkamb.io.scene.case import Case
from tkamb.knee.contact_points import CondylePoint
from tkamb.knee.equations import solve_knee, unsolved
from tkamb.knee.equilibrium.adjusted_press import press_adjusted
from tkamb.knee.equilibrium.frame_contact import FrameContact
from tkamb.knee.equilibrium.post_side import cam_on_post, post_contact
from tkamb.knee.equilibrium.split_sensitivity import split_sensitivity, split_tangent
from tkamb.run.mechanics import FrameLoads, Mechanics

if TYPE_CHECKING:
    from tkamb.contact.cam_post import CamPost
    from tkamb.contact.model import ContactModel
    from tkamb.knee.equilibrium.released import KneeEquilibrium

NAN = float("nan")


@dataclass(frozen=True)
class CouplingSettings:
    """The iteration between contact and muscles of one frame."""

    force_tolerance: float = 0.1
    """N; the iteration has converged when the load changes by less. Chosen: a ten-thousandth of a
    body weight is not resolved by any contact model."""
    point_tolerance: float = 1e-6
    """m; and when the centres of pressure move by less. Chosen: far below what changes a force."""
    max_iterations: int = 20
    """Iterations after which a frame without convergence gets a status. Chosen: frames that
    converge need fewer."""
    stiffness_error: float = 0.02
    """Share of the stiffness of the muscles that a converged search may neglect. Chosen: the search
    converges nevertheless."""


COUPLING = CouplingSettings()


class ContactSide:
    """The contact model of a case, prepared once, and the body that it has to agree with.

    Args:
        case: a case with [contact].
        mechanics: its body side.
        state: what the model's `prepare` returned for these surfaces, if there is one already.
        sensitivity: whether each frame tells how its split changes with the adduction, which
            takes one more press of a model without a tangent.
        post: cam and post, if they are prepared already.
        model: what prepared `state`, if there is one already.
    """

    def __init__(
        self,
        case: Case,
        mechanics: Mechanics,
        state: Any = None,
        sensitivity: bool = True,
        post: "CamPost | None" = None,
        model: "ContactModel | None" = None,
    ) -> None:
        table = case.scene.contact
        insert = case.scene.implant.insert
        assert table is not None and insert is not None
        assert case.femoral is not None and case.insert is not None
        self.case, self.table, self.mechanics = case, table, mechanics
        self.model = model or contact_model(table.model, table.resolution_mm, **table.options)
        pair = ContactPair(
            case.femoral, case.insert, given_material(case.scene.insert_material), insert.bearing
        )
        start = clock.perf_counter()
        self.state = self.model.prepare(pair) if state is None else state
        self.post = cam_on_post(case, self.model, self.state.pair.material, post)
        self.prepare_seconds = clock.perf_counter() - start

        self._sensitivity = sensitivity and "adduction" not in table.released
        self._probe = self.model.probe(self.state)
        self.released = None
        if table.released:
            from tkamb.knee.equilibrium.released import ReleasedKnee
            from tkamb.knee.equilibrium.starts import InitialPoses

            probe = self._probe if self.post is None else self.post.probe_with(self._probe)
            self.released = ReleasedKnee(mechanics, probe, table.released)
            recorded = case.motion.coordinates
            self.starts = InitialPoses(recorded, self.released, self.state.pair, self.post)

    def frame(self, k: int, before: Sequence[FrameContact] = ()) -> tuple[FrameLoads, FrameContact]:
        """Return body and contact of frame k, as coupled as the scene asks.

        Args:
            k: frame.
            before: the contacts of the frames before: the last one's warm start saves time,
                and the last that were found are where released coordinates begin.
        """
        if self.released is None:
            body, contact = self._press_recorded(k, before)
        else:
            body, contact = self._release(k, before)
        if contact.result is None or body.loads.problems or self.case.split is None:
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
        """Return body and contact at the recorded rotation."""
        begin, pose = before[-1].start if before else None, self.mechanics.poses[k]
        # Every press asks where the bodies first touch, of which the body's equations need nothing.
        body, _ = both(lambda: self.mechanics.frame(k), lambda: self.state.pair.touch_at(pose))
        contact = self.carry(body, self.mechanics.poses[k], begin)
        if contact.adjustment and contact.adjustment.restored:
            body = self.mechanics.frame(k, contact.adjustment)
            contact = self.carry(body, self.mechanics.poses[k], contact.start)
        if self.table.coupling == "none" and self.post is None:
            return body, contact
        return self._couple(k, body, contact)

    def carry(self, body: FrameLoads, pose: Array, begin: WarmStart | None) -> FrameContact:
        """Press in what the body asks for, at the measured (or adjusted) rotation.

        Args:
            body: the body side of the frame.
            pose: (4, 4) measured pose_femoral_in_insert.
            begin: the previous frame's warm start, which may save time.
        """
        load = float(body.loads.contact_force[1])
        if not np.isfinite(load):
            return self.nothing("no load from the equations")
        if load <= 0:
            return self.nothing("no compressive load")
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
        """Return body and contact once the one's resultants and post act in the other."""
        seconds, place = contact.seconds, self.case.motion.coordinates[k]
        for iteration in range(1, COUPLING.max_iterations + 1):
            if contact.result is None:
                return body, contact
            load, points = body.loads.contact_force[1], _points(body)
            coupled = self.table.coupling == "points"
            result = self.resultants(k, place, contact.result) if coupled else {}
            post = post_contact(self.post, contact.result.pose, self.table)
            if post is not None and post.problem:
                return replace(body, loads=unsolved([post.problem])), replace(
                    contact, result=None, problem=post.problem, post=post
                )
            pushed = self.mechanics.post_loads(k, place, post.load if post else None)
            geometry = replace(body.geometry, condyles=body.geometry.condyles | result, post=pushed)
            geometry, loads = self.mechanics.solved(k, geometry)
            body = replace(body, geometry=geometry, loads=loads)
            contact = self.carry(body, self.mechanics.poses[k], contact.start)
            seconds += contact.seconds
            change = abs(float(body.loads.contact_force[1] - load))
            moved = _travel(points, _points(body))
            contact = replace(
                contact,
                seconds=seconds,
                iterations=iteration,
                load_change=change,
                point_change=moved if coupled else NAN,
                post=post,
            )
            if change < COUPLING.force_tolerance and moved < COUPLING.point_tolerance:
                return body, contact
        problem = "body and contact do not come to agree"
        return replace(body, loads=unsolved([problem])), replace(
            contact, result=None, problem=problem
        )

    def _release(self, k: int, before: Sequence[FrameContact]) -> tuple[FrameLoads, FrameContact]:
        """Return body and contact with the released coordinates at rest.

        Args:
            k: frame.
            before: the contacts of the frames before; where the last three that were found
                go on is where the search begins.
        """
        released, began = self.released, clock.perf_counter()
        assert released is not None
        good = [contact for contact in before if contact.equilibrium and not contact.problem][-3:]
        begin = good[-1].start if good else None
        points = {} if len(released.released) == 5 else self._nearest_points(k)
        try:
            knee = self.starts.rest(k, [c.equilibrium for c in good if c.equilibrium], points)
        except ComputationError as error:
            contact = self.nothing(error.what)
            body = self.mechanics.frame(k)
            return replace(body, loads=unsolved([contact.problem])), contact
        result, contact = None, self.nothing(knee.problem)
        if not knee.problem:
            pose, pair = knee_pose(knee.coordinates), self.state.pair
            # The check that follows asks where the bodies first touch.
            (result, start), _ = both(
                lambda: self.model.evaluate_from(self.state, pose, begin),
                lambda: pair.touch_at(pose),
            )
            result = within_insert(self.state, result)
            contact = self._contact(result, start, None, 0.0)
            flags = (*contact.flags, *_doubts(knee))
            post = post_contact(self.post, result.pose, self.table)
            contact = replace(contact, flags=flags, post=post)
        contact = replace(
            contact,
            seconds=clock.perf_counter() - began,
            iterations=knee.passes,
            load_change=knee.change,
            equilibrium=knee,
        )
        body = self._equilibrium_loads(k, knee, contact, points)
        if body.loads.problems:
            return body, replace(contact, result=None, problem=body.loads.problems[0])
        return body, contact

    def _equilibrium_loads(
        self, k: int, knee: "KneeEquilibrium", contact: FrameContact, points: dict[str, Array]
    ) -> FrameLoads:
        start, geometry = clock.perf_counter(), knee.geometry
        if contact.result is None:
            loads = unsolved([contact.problem])
        else:
            up, still = np.array([0.0, 1.0, 0.0]), np.zeros(3)
            separated = {
                side: CondylePoint(point, up, still, NAN) for side, point in points.items()
            }
            touching = self.resultants(k, knee.coordinates, contact.result)
            lifted = frozenset(self.mechanics.sides - set(touching))
            geometry = replace(
                geometry,
                condyles=separated | touching,
                lifted=lifted,
                post=self.mechanics.post_loads(k, knee.coordinates, knee.contact.post),
            )
            loads = solve_knee(geometry, self.mechanics.friction)
        seconds = clock.perf_counter() - start
        return FrameLoads(geometry, loads, None, 0.0, seconds)

    def resultants(self, k: int, place: Array, result: ContactResult) -> dict[str, CondylePoint]:
        """Return the contact's resultants as the contact points of the equations."""
        return self.mechanics.resultants(k, place, condyle_wrenches(result, self.case.split))

    def _nearest_points(self, k: int) -> dict[str, Array]:
        query = self.mechanics.query
        assert query is not None
        gaps = query.at(self.mechanics.poses[k])
        result = {"medial": gaps.medial.centre}
        return result | ({"lateral": gaps.lateral.centre} if gaps.lateral else {})

    def _contact(
        self,
        result: ContactResult,
        start: WarmStart,
        adjustment: Adjustment | None,
        seconds: float,
    ) -> FrameContact:
        medial = medial_points(self.state.points, result.pose, self.case.split)
        if result.status is not ContactStatus.OK:
            reason = f"contact {result.status.value.replace('_', ' ')}"
            words = "; ".join((reason, *result.flags))
            return FrameContact(None, medial, adjustment, seconds, words, ())
        return FrameContact(
            result, medial, adjustment, seconds, "", result.flags,
            start=start, triangles=self.state.triangles,
        )  # fmt: skip

    def nothing(self, problem: str) -> FrameContact:
        """Return a contact that could not be computed, and why."""
        none = np.zeros(len(self.state.points), bool)
        return FrameContact(None, none, None, 0.0, problem, ())


def insert_material_as_json(scene: Scene) -> dict[str, Any]:
    """Return all numbers of the insert's material, MPa, and their sources."""
    return material_as_json(given_material(scene.insert_material))


def _doubts(knee: "KneeEquilibrium") -> tuple[str, ...]:
    """Return a flag where the response of the coordinates to the muscles has not converged."""
    if knee.doubt <= COUPLING.stiffness_error:
        return ()
    return (
        "the response of the knee's coordinates to the muscles has not converged "
        f"({100 * knee.doubt:.0f} % of it is open): from other initial guesses such frames "
        "differed by up to 3 % in the total force and 60 N in the force of one condyle",
    )


def _points(body: FrameLoads) -> dict[str, Array]:
    return {side: condyle.point for side, condyle in body.geometry.condyles.items()}


def _travel(before: dict[str, Array], after: dict[str, Array]) -> float:
    """Return the farthest (m) that a contact point has moved."""
    return max(float(np.linalg.norm(after[side] - before[side])) for side in after)
