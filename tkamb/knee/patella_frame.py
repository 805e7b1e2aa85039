"""The released patella in the equations of the knee.

The heads of the quadriceps share the tension Q, and `tkamb.knee.patella_body` finds the massless
patella in equilibrium with them. Strands of the patellar ligament and tibial retinacula then pull
the tibia with a wrench w_T(Q), and the patella passes the opposite wrench on to the femur:

    w_F = -w_T.

Heads, femoral retinacula and contact are internal to femur and patella. In the equations of the
knee the extensor mechanism is therefore one unknown, Q, on the pair w_T/Q and w_F/Q. The equations
give a tension f(Q) at the patella of Q. The search solves f(Q) - Q = 0 by the secant method, with
the tension of the plane patella as first guess, and returns the Q with the smallest difference. The
femur carries weight and inertia of the patella, up to 5 N.
"""

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.knee.button import Button
from tkamb.knee.chain import Chain
from tkamb.knee.equations import Extensor, KneeGeometry, SolvedLoads, unsolved
from tkamb.knee.found_patella import (
    LIGHT_PRESS,
    FoundPatella,
    complete_patella,
    first_balance,
    pressed_coordinates,
)
from tkamb.knee.ligaments import Ligament, ligament_loads
from tkamb.knee.load import LinkPoint, PointForces, scaled, wrench_of, wrenches
from tkamb.knee.patella_body import (
    PLANE,
    Head,
    PatellaBalance,
    PatellaBody,
    coordinates_of,
    released_numbers,
)
from tkamb.knee.released_forces import StrandLines
from tkamb.knee.unknowns import Unknown
from tkamb.knee.wrapping import TautPath

if TYPE_CHECKING:
    from tkamb.contact.model import Probe

Solve = Callable[[KneeGeometry], tuple[KneeGeometry, SolvedLoads]]

# 1: difference of the two tensions, relative to the tension, at which the search ends.
TENSION_TOLERANCE = 1e-7
# 1: relative difference above which a frame is flagged. A larger one remains where the force of
# the button's contact jumps from facet to facet.
FLAGGED_TENSION = 1e-6
# 1: relative difference above which a frame fails. Such jumps are up to 5e-5 of the tension
# (`scripts/measure/patella_residuals`).
LARGEST_TENSION = 1e-4
# 1: evaluations of the patella in one search. Usual are three.
MAX_TENSIONS = 12


@dataclass(frozen=True, eq=False)
class HeadShare:
    """A head of the quadriceps with its share of the tension.

    Args:
        name: name of the head.
        origin: point on the femur.
        insertion: point on the patella.
        share: share of the tension of the quadriceps, 1.
    """

    name: str
    origin: LinkPoint
    insertion: LinkPoint
    share: float


@dataclass(frozen=True, eq=False)
class PatellaLoads:
    """The released patella of one frame, in the equations of the knee.

    Args:
        tension: tension of the quadriceps that pulls it, N.
        forces: name -> magnitude of patellar ligament and patellofemoral force, N, as loads of the
            plane patella.
        plane: the extensor mechanism of the plane patella.
        plane_muscles: its muscles.
        plane_force: its patellofemoral force, insert frame, shape (3,), N.
        coordinates: coordinates (6,) of the patella, m and rad.
        lines: loads of the ligaments from patella to tibia on the links, N.
        straight: ends on patella and tibia of those that do not wrap, insert frame, shape
            (2, k, 3), m, and their tensions, shape (k,), N.
        tensions: head -> tension, N.
        found: the patella in equilibrium; None: in an iteration of the search.
        heads: loads of the heads of the quadriceps on the patella, N; None: as `found`.
        paths: head -> its path to the patella, insert frame; empty: as `found`.
    """

    tension: float
    forces: dict[str, float]
    plane: Extensor
    plane_muscles: tuple[Unknown, ...]
    plane_force: Array
    coordinates: Array
    lines: tuple[PointForces, ...]
    straight: tuple[Array, Array]
    tensions: dict[str, float]
    found: FoundPatella | None = None
    heads: PointForces | None = None
    paths: dict[str, TautPath] = field(default_factory=dict)

    def plane_of(self, geometry: KneeGeometry) -> KneeGeometry:
        """Return a geometry with the plane patella instead of this one."""
        return replace(geometry, extensor=self.plane, muscles=self.plane_muscles)

    def strands(self, insert_in_femur: Array) -> StrandLines:
        """Return the ligaments to the tibia as lines whose ends are fixed to femur and insert.

        Args:
            insert_in_femur: pose, shape (4, 4).
        """
        (patella, tibia), tensions = self.straight
        resultant = self.forces["patellar_ligament"]
        total = _on_tibia(self.lines)
        along = patella - tibia
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        straight = wrench_of(tibia, tensions[:, None] * along).sum(axis=0)
        return StrandLines(
            transform(insert_in_femur, patella),
            tibia,
            tensions / resultant,
            (total - straight) / resultant,
        )


@dataclass(frozen=True, eq=False)
class PatellaMethod:
    """How the patella of a knee is found in the frames of a motion.

    Args:
        button: contact of button and femoral component.
        chain: chain of the knee.
        heads: heads of the quadriceps.
        lines: strands of the patellar ligament and retinacula, with slack lengths.
        outline: outline that all heads wrap, in the femur's x-y plane, shape (n, 2), m; None: they
            are straight.
        released: names of the released coordinates, with ap, si and flexion. The others are zero.
    """

    button: Button
    chain: Chain
    heads: tuple[HeadShare, ...]
    lines: tuple[Ligament, ...]
    outline: Array | None
    released: tuple[str, ...]

    @cached_property
    def carried(self) -> tuple[Ligament, ...]:
        """The lines with all points on femur, tibia and patella."""
        placed = {}
        for link in {link for line in self.lines for link in line.links}:
            carrier = self.chain.carrier(link)
            placed[link] = (carrier, self.chain.link_in(link, carrier))
        return tuple(line.on_links(placed) for line in self.lines)

    @cached_property
    def _numbers(self) -> tuple[int, ...]:
        return released_numbers(self.released)

    def _point(self, point: LinkPoint, link: str) -> Array:
        return transform(self.chain.link_in(point.link, link), point.position)

    def body_of_heads(
        self,
        poses: Mapping[str, Array],
        tensions: Mapping[str, float],
        probe: "Probe | None" = None,
        bones: Mapping[str, Array] | None = None,
    ) -> PatellaBody:
        """Return the forces on the patella from the tensions of its heads.

        Args:
            poses: link -> pose (4, 4) in the insert frame of femur and tibia.
            tensions: head -> tension, N; a head without one is slack.
            probe: see `balanced`.
            bones: link -> pose (4, 4) in the link of its bone, which has the attachments and the
                patella's joint. The outline and the component are those of the link. None: bones
                and links are the same.
        """
        bones = {"patella": np.eye(4), "femur": np.eye(4), "tibia": np.eye(4)} | dict(bones or {})
        heads = [
            Head(
                head.name,
                transform(bones["femur"], self._point(head.origin, "femur")),
                self._point(head.insertion, "patella"),
                self.outline,
                tensions.get(head.name, 0.0),
            )
            for head in self.heads
        ]
        joint = bones["femur"] @ self.chain.patella_joint_in_femur
        placed = {link: (link, bone) for link, bone in bones.items()}
        lines = [line.on_links(placed) for line in self.carried]
        return PatellaBody(
            self.button, probe or self.button.contact.probe(), joint, heads, lines, poses
        )

    def solved(
        self, geometry: KneeGeometry, solve: Solve, start: Array | None = None
    ) -> tuple[KneeGeometry, SolvedLoads]:
        """Return a geometry with the released patella, and its loads.

        Args:
            geometry: the frame, with the plane patella or the released one of an earlier solution.
            solve: solver of the equations for a geometry.
            start: coordinates (6,) of the patella in the last frame, the first guess; None:
                unknown.
        """
        extensor = geometry.extensor
        assert extensor is not None
        before = extensor.released
        plane = geometry if before is None else before.plane_of(geometry)
        if before is None:
            plane, loads = solve(plane)
            if loads.problems or loads.slack:
                return plane, loads
            tension = extensor.tension(loads.values)
            force = loads.values["patellofemoral"] * extensor.contact_normal
        else:
            tension, force = before.tension, before.plane_force
            start = before.coordinates
        try:
            return self._search(plane, solve, tension, force, start)
        except ComputationError as error:
            return plane, unsolved([f"patella: {error.what}"])

    def pulled(
        self, plane: KneeGeometry, tension: float, ratio: float, start: Array | None, complete: bool
    ) -> KneeGeometry:
        """Return a geometry with the released patella under a tension; the equations may differ.

        Args:
            plane: the frame with the plane patella.
            tension: tension of the quadriceps, N.
            ratio: patellofemoral force over this tension of the plane patella.
            start: coordinates (6,) of the patella as first guess; None: unknown.
            complete: whether the result has contact, tensions and flags.
        """
        extensor, words, began = plane.extensor, "", clock.perf_counter()
        assert extensor is not None
        force = tension * max(ratio, LIGHT_PRESS) * extensor.contact_normal
        try:
            body, balance = self.balanced(plane, tension, force, start)
            words = balance.problem
            if not words:
                result = self._on_knee(plane, body, balance, force)
                if result is not None:
                    return self._complete(result, body, balance, 0.0, began) if complete else result
                words = "patella: no ligament to the tibia is taut"
        except ComputationError as error:
            words = f"patella: {error.what}"
        return replace(plane, problems=(*plane.problems, words))

    def _search(
        self, plane: KneeGeometry, solve: Solve, tension: float, force: Array, start: Array | None
    ) -> tuple[KneeGeometry, SolvedLoads]:
        """Return geometry and loads at the tension that the patella and the equations agree on.

        Args:
            plane: the frame with the plane patella.
            solve: see `solved`.
            tension: first guess, N.
            force: patellofemoral force on the plane patella, insert frame, shape (3,), N.
            start: see `solved`.

        Raises:
            ComputationError: the plane patella cannot be pressed, or a line has no path.
        """
        began, last, best = clock.perf_counter(), None, None
        probe = self.button.contact.probe()
        for _ in range(MAX_TENSIONS):
            body, balance = self.balanced(plane, tension, force, start, probe)
            if balance.problem:
                return plane, unsolved([balance.problem])
            start = balance.coordinates
            on_knee = self._on_knee(plane, body, balance, force)
            if on_knee is None:
                # Other lines hold the patella: a larger tension makes the strands taut.
                tension *= 2.0
                continue
            trial, loads = solve(on_knee)
            if loads.problems:
                return trial, loads
            if loads.slack:
                return solve(plane)
            assert trial.extensor is not None
            change = trial.extensor.tension(loads.values) - tension
            # Where the contact's force jumps, later tensions need not be closer.
            if best is None or abs(change) < abs(best[0]):
                best = change, trial, loads, body, balance
            if abs(change) <= TENSION_TOLERANCE * tension:
                break
            slope = -1.0 if last is None else (change - last[1]) / (tension - last[0])
            last = tension, change
            step = -change / slope if slope < 0.0 else change
            # A step of more than half the tension leaves the range in which the slope holds.
            tension += float(np.clip(step, -0.5 * tension, tension))
        if best is None or abs(best[0]) > LARGEST_TENSION * tension:
            words = "patella: the iteration of pose and tension does not converge"
            return plane, unsolved([complete_patella(body, balance).problem or words])
        change, trial, loads, body, balance = best
        return self._complete(trial, body, balance, change, began), loads

    def head_tensions(self, tension: float) -> dict[str, float]:
        """Return head -> tension, N, of a tension of the quadriceps, N."""
        return {head.name: head.share * tension for head in self.heads}

    def balanced(
        self,
        geometry: KneeGeometry,
        tension: float,
        force: Array,
        start: Array | None,
        probe: "Probe | None" = None,
    ) -> tuple[PatellaBody, PatellaBalance]:
        """Return the forces on the patella, and its equilibrium at a tension of the quadriceps.

        Args:
            geometry: the frame, with the plane patella.
            tension: N.
            force: patellofemoral force on the patella, insert frame, shape (3,), N. It presses the
                plane patella, the initial guess.
            start: see `solved`.
            probe: probe of the button's contact, with the last contact as warm start; None: new.

        Raises:
            ComputationError: the plane patella cannot be pressed.
        """
        state = geometry.state
        poses = {link: state.pose(link) for link in ("femur", "tibia")}
        body = self.body_of_heads(poses, self.head_tensions(tension), probe)
        plane = coordinates_of(inverse(poses["femur"] @ body.joint) @ state.pose("patella"))
        guesses: list[Callable[[], Array]] = []
        if start is not None:
            guesses.append(lambda: start)
        guesses.append(lambda: pressed_coordinates(body, plane[list(PLANE)], force))
        return body, first_balance(body, guesses, self._numbers, near=start is not None)

    def _on_knee(
        self, plane: KneeGeometry, body: PatellaBody, balance: PatellaBalance, force: Array
    ) -> KneeGeometry | None:
        """Return the frame with the loads of a released patella per newton of the quadriceps.

        None: no ligament from patella to tibia is taut.

        Args:
            plane: the frame with the plane patella.
            body: forces on the patella.
            balance: its equilibrium.
            force: patellofemoral force on the plane patella, insert frame, shape (3,), N.
        """
        extensor = plane.extensor
        assert extensor is not None
        tension = sum(head.tension for head in body.heads)
        poses = body.poses | {"patella": body.patella(balance.coordinates)}
        shank = [line for line in body.lines if "tibia" in line.links]
        on_tibia = tibial_wrench(body, balance.coordinates)
        pulls, lines = ligament_loads(shank, poses)
        straight = [k for k, line in enumerate(shank) if not line.wraps]
        ends = [
            [
                transform(poses[link], end.position)
                for k in straight
                for end in (shank[k].proximal, shank[k].distal)
                if end.link == link
            ]
            for link in ("patella", "tibia")
        ]
        if not np.any(on_tibia):
            return None
        unit, zero = on_tibia / tension, np.zeros((1, 3))
        pull = body.pull(balance.coordinates)[:3]
        ligament = float(np.linalg.norm(on_tibia[:3]))
        released = PatellaLoads(
            tension,
            {
                "patellar_ligament": ligament,
                "patellofemoral": float(np.linalg.norm(pull)),
                "patellofemoral_tangential": 0.0,
            },
            extensor,
            plane.muscles,
            force,
            balance.coordinates,
            lines,
            (np.array(ends).reshape(2, -1, 3), pulls[straight]),
            {head.name: head.tension for head in body.heads},
        )
        (muscle,) = plane.muscles
        loads = (
            PointForces("tibia", zero, unit[None, :3], unit[3:]),
            PointForces("femur", zero, -unit[None, :3], -unit[3:]),
        )
        back = poses["patella"] @ self.button.in_patella
        normal = -rotate(back, pull) / np.linalg.norm(pull)
        on_knee = replace(
            extensor,
            patellar_ligament=tuple(scaled(lines, 1.0 / ligament)),
            contact_normal=normal,
            released=released,
        )
        return replace(plane, extensor=on_knee, muscles=(Unknown(muscle.name, loads),))

    def _complete(
        self,
        geometry: KneeGeometry,
        body: PatellaBody,
        balance: PatellaBalance,
        change: float,
        began: float,
    ) -> KneeGeometry:
        """Return a geometry with contact, tensions and flags of its released patella.

        Args:
            geometry: result of `_on_knee`.
            body: forces on the patella.
            balance: its equilibrium.
            change: difference of the two tensions, N.
            began: time at which the search began, s.

        Raises:
            ComputationError: the button is not in contact.
        """
        found, extensor = complete_patella(body, balance), geometry.extensor
        assert extensor is not None and extensor.released is not None
        if found.press is None:
            raise ComputationError(found.problem.removeprefix("patella: "))
        flags, tension = found.flags, extensor.released.tension
        if abs(change) > FLAGGED_TENSION * tension:
            words = f"patella: its tension and that of the equations differ by {abs(change):.2g} N"
            flags = (*flags, words)
        press = replace(found.press, seconds=clock.perf_counter() - began)
        found = replace(found, press=press, flags=flags)
        heads = PointForces("patella", *body.head_forces(balance.coordinates))
        paths = body.head_paths(balance.coordinates)
        released = replace(extensor.released, found=found, heads=heads, paths=paths)
        extensor = replace(extensor, contact_point=press.centre, released=released)
        return replace(geometry, extensor=extensor)


def tibial_wrench(body: PatellaBody, coordinates: Array) -> Array:
    """Return the wrench (6,) of the patella's ligaments on the tibia, about the insert's origin.

    Args:
        body: forces on the patella.
        coordinates: its coordinates, shape (6,).

    Raises:
        ComputationError: a ligament has no taut path.
    """
    poses = body.poses | {"patella": body.patella(coordinates)}
    shank = [line for line in body.lines if "tibia" in line.links]
    return _on_tibia(ligament_loads(shank, poses)[1])


def _on_tibia(loads: Sequence[PointForces]) -> Array:
    acting = [load for load in loads if load.link == "tibia"]
    return np.asarray(wrenches(acting).sum(axis=0))
