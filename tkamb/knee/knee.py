"""`tkamb.Knee`: a total knee replacement on any Pinocchio model.

    knee = tkamb.Knee(model, side="right", implant=..., ligaments=[...], contact=..., friction=0.05)
    tau = pin.rnea(model, data, q, v, a, knee.external_forces(q, v))

SI units; NumPy arrays and Pinocchio types in and out. No file is read, nothing is printed, and no
call changes the next: what may save time is a `KneeData` that the caller makes and hands over.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import pinocchio as pin

from tkamb.errors import ComputationError, InputError, names_near
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    Array,
    cross,
    inverse,
    knee_pose,
    mirrored_pose,
    transform,
)
from tkamb.knee.anatomy import Place, find_anatomy, knee_size
from tkamb.knee.canonical import Bridge, CanonicalChain, KneePlace, mirrored_spatial, se3, summed
from tkamb.knee.contact_points import NO_CONTACT, CondylePoint, contact_points
from tkamb.knee.equations import KneeGeometry, solve_knee, solved_unknowns, unsolved
from tkamb.knee.instant import Instant, PatellaAt
from tkamb.knee.load import PointForces
from tkamb.knee.loads import KneeLoads, knee_loads
from tkamb.knee.muscles import Muscle
from tkamb.knee.parts import (
    Extensor,
    Implant,
    as_surface,
    link_point,
    mirrored_surface,
)

if TYPE_CHECKING:
    from tkamb.contact.model import ContactModel
    from tkamb.contact.probe import ProbedContact
    from tkamb.contact.result import ContactResult
    from tkamb.contact.warm_start import Guess, WarmStart
    from tkamb.geometry.closest import ClosestPointQuery
    from tkamb.geometry.surface import Surface
    from tkamb.knee.contact import KneeContact
    from tkamb.knee.equilibrium.released import KneeEquilibrium
    from tkamb.knee.ligaments import BundleArrays, Ligament
    from tkamb.knee.patella import PatellaState

PATELLAR_LIGAMENT = "patellar_ligament"
"""Its name among the tensions."""


@dataclass(frozen=True)
class KneeSettings:
    """The knee object: frames and poses."""

    frame_tolerance: float = 1e-9
    """m and rad: an insert frame this near to that of its flat bottom is the same frame. Chosen:
    above rounding."""
    pose_tolerance: float = 1e-12
    """m and rad: residual of the joint coordinates that make a given pose of the knee. Chosen: near
    the rounding of double precision."""
    accepted_pose_error: float = 1e-8
    """m and rad: at most what is left after the last Newton step of a pose that is reached. Chosen:
    far below what changes a force."""
    max_pose_steps: int = 30
    """Newton steps at most to find these coordinates. Chosen: poses that converge need fewer."""


KNEE = KneeSettings()


@dataclass(eq=False)
class KneeData:
    """What a caller hands from one call to the next to save time; made by `Knee.create_data`.

    It changes how long a call takes, and no answer beyond the solver's tolerance.

    Args:
        data: Pinocchio's, of the user's model.
        probe: of the contact model, which remembers the last contact; None without one.
        patella: where the patella was found last.
        seen: the last pose, as bytes, and the contact there.
    """

    data: Any
    probe: Any = None
    patella: "PatellaState | None" = None
    seen: "tuple[bytes, ProbedContact] | None" = None


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A knee whose released coordinates are in equilibrium.

    Args:
        q: (nq,) configuration of the user's model; the joints of the knee have moved.
        coordinates: (6,) knee coordinates there, those of a right knee, m and rad.
        loads: the knee's loads there.
        contact: the contact there; None where there is no equilibrium.
        residual: N, the largest force (moments over 25 mm) left on a released coordinate.
        stiffness: (n, n) of the released coordinates, scaled alike, N/m.
        problem: why this is no equilibrium, or empty.
        search: all about the search.
    """

    q: Array
    coordinates: Array
    loads: KneeLoads
    contact: "ContactResult | None"
    residual: float
    stiffness: Array
    problem: str
    search: "KneeEquilibrium"


@dataclass(frozen=True, eq=False)
class _Line:
    """A muscle of given tension, straight from point to point, on any frames of the model."""

    places: tuple[Place, ...]
    positions: tuple[Array, ...]


class Knee:
    """A total knee replacement on a user's Pinocchio model.

    The knee lies between the frames "femur" and "tibia" of the model, whatever joints are between
    them, above and below. Its parts stand in these frames, found by name or given by `frames`:

    - `femur`, `tibia`: needed; attachment points may lie on any frame that is fixed to them;
    - `femoral`: axes of the femoral component's mesh, fixed to the femur; else `femur`;
    - `insert`: axes of the insert's mesh, fixed to the tibia; else the placement of a joint
      "knee_ap" on the tibia; else `tibia`;
    - `patella`: a body that moves against the femur; else the extensor mechanism finds its place;
    - `hip`: hip centre, fixed to the femur; else the joint that carries the femur.

    What is not given is not modelled, not imported and not computed.

    Args:
        model: any Pinocchio model; it is not changed.
        side: of the body, "right" or "left".
        implant: meshes, see `Implant`.
        ligaments: bundles, with slack lengths.
        extensor: quadriceps, patella and patellar ligament.
        contact: a contact model (`tkamb.contact_model`) or its name; None: no contact.
        friction: Coulomb coefficient of the femorotibial contact.
        muscles: lines of given tension between any frames of the model, straight from point to
            point.
        frames: part of the knee -> name of its frame in the model.
        joints: names of the knee's joints, for a check; they are found in the tree.
        cache: whether a lattice keeps its prepared operators on disk for the next time.

    Raises:
        InputError: what is given does not fit together, in one line.
    """

    def __init__(
        self,
        model: pin.Model,
        side: Literal["right", "left"] = "right",
        *,
        implant: Implant | None = None,
        ligaments: "Iterable[Ligament]" = (),
        extensor: Extensor | None = None,
        contact: "ContactModel | str | None" = None,
        friction: float = 0.0,
        muscles: Iterable[Muscle] = (),
        frames: Mapping[str, str] | None = None,
        joints: Sequence[str] = (),
        cache: bool = False,
    ) -> None:
        if side not in ("right", "left"):
            raise InputError(f"side {side!r}", "Knee", "give 'right' or 'left'")
        if not 0.0 <= friction < 1.0:
            raise InputError(f"friction {friction}", "Knee", "give 0 to 1")
        self.model, self.side, self.friction = model, side, float(friction)
        self.implant, left = implant or Implant(), side == "left"
        plane = extensor.plane if extensor else None
        self.anatomy = find_anatomy(model, frames or {}, joints, plane)
        self.femoral, self.insert, self.button = self._surfaces(left, contact, extensor)
        component, insert = self.anatomy.femoral, self._insert_place(left)
        self.chain = CanonicalChain(self.anatomy, left, extensor is not None, component, insert)
        self.bridge = Bridge(self.anatomy, left, self.chain, component, insert)
        self.ligaments = tuple(self._bundle(bundle) for bundle in ligaments)
        self._crossing, self._others = self._divided()
        self._lines = {muscle.name: self._line(muscle) for muscle in muscles}
        self.extensor, self._extensor_lines = extensor, cast(Any, None)
        if extensor is not None:
            self._extensor_lines = self._build_extensor(extensor, left)
        self._query: ClosestPointQuery | None = None
        self.contact = None if contact is None else self._build_contact(contact, cache)

    def create_data(self) -> KneeData:
        """Return an object that a caller hands from call to call to save time."""
        probe = None if self.contact is None else self.contact.probe()
        return KneeData(self.model.createData(), probe)

    def pose(self, q: Array) -> pin.SE3:
        """Return the pose of the femoral component in the insert frame."""
        place = self._kinematics(self.create_data_for_kinematics(), q)
        return se3(mirrored_pose(place.pose) if self.left else place.pose)

    def coordinates(self, q: Array) -> Array:
        """Return the knee coordinates (6,) in the order of `KNEE_COORDINATES`, m and rad.

        After Grood and Suntay; those of a left knee are those of its mirror image, whose clinical
        signs are the same (`tkamb.geometry.frames`).
        """
        return self._kinematics(self.create_data_for_kinematics(), q).coordinates

    @property
    def left(self) -> bool:
        """Whether it is a left knee."""
        return self.side == "left"

    def create_data_for_kinematics(self) -> KneeData:
        """Return data without a contact."""
        return KneeData(self.model.createData())

    def external_forces(
        self,
        q: Array,
        v: Array,
        tensions: Mapping[str, float] | float | None = None,
        data: KneeData | None = None,
    ) -> Any:
        """Return what contact, ligaments and muscles do to the bodies at q and v.

        The contact follows from the overlap of the bodies at q, its friction from v. A tension of
        the quadriceps is carried on by the patella, massless, to patellar ligament and femur.

        Args:
            q: (nq,).
            v: (nv,).
            tensions: muscle -> N; a number alone is the quadriceps'. What is missing is slack.
                "patellar_ligament" -> N beside the quadriceps: then its tension is that, and the
                patellofemoral force what the two leave, as in `KneeLoads.tensions`.
            data: from `create_data`, to save time.

        Returns:
            `pin.StdVec_Force`, one per joint in its joint's frame: `fext` of `pin.rnea` and
            `pin.aba`.

        Raises:
            InputError: q or v of the wrong size, or an unknown muscle.
            ComputationError: the contact model is out of its range, or there is no place for the
                patella.
        """
        data = self.create_data() if data is None else data
        place = self._kinematics(data, q, v)
        on_insert = np.zeros(6)
        if self.contact is not None:
            contact = self._contact_at(data, place)
            on_insert = self.contact.wrench(contact, self.bridge.twist(data.data))
        if self._crossing is not None:
            on_insert = on_insert + self._crossing.wrench(place.pose)
        pulled = self._tensions(tensions)
        total: list[PointForces] = []
        if self._others or self._pulls(pulled):
            patella = None
            if self.extensor is not None:
                patella = self._find_patella(place, data)
            poses = self._link_poses(place, patella)
            if self._others:
                from tkamb.knee.ligaments import ligament_loads

                total += ligament_loads(self._others, poses)[1]
            if patella is not None and self._pulls(pulled):
                total += self._extensor_pull(poses, place, patella, pulled)
        links = summed(total)
        for link, sign in (("tibia", 1.0), ("femur", -1.0)):
            links[link] = links.get(link, np.zeros(6)) + sign * on_insert
        forces = self.bridge.joint_forces(data.data, links)
        return self._with_lines(data, pulled, forces) if self._lines else forces

    def stiffness(
        self, q: Array, v: Array, data: KneeData | None = None, exact: bool = True
    ) -> Array:
        """Return the derivative (6, 6) of the femorotibial wrench by the relative twist.

        The wrench is that of contact, its friction and ligaments between femur and tibia on the
        insert: force (N), moment about the insert's origin (N·m). The displacement is that of
        the femoral component against the insert: its point at the insert's origin (m), then its
        rotation (rad). Both are in the insert frame; v stays. Positive: pressed in, the femur
        pushes the insert with more force that way.

        Args:
            q: (nq,).
            v: (nv,).
            data: from `create_data`, to save time.
            exact: False: the tangent that the contact model brings, where it brings one, even
                where it is a guide only (the softened lattice's).

        Raises:
            ComputationError: see `external_forces`.
        """
        data = self.create_data() if data is None else data
        place = self._kinematics(data, q, v)
        total = np.zeros((6, 6))
        if self.contact is not None:
            twist = self.bridge.twist(data.data)
            contact = self._contact_at(data, place)
            total += self.contact.stiffness(data.probe, place.pose, contact, twist, exact)
        total += self._ligament_stiffness(place)
        return self._mirrored_matrix(total)

    def damping(self, q: Array, v: Array, data: KneeData | None = None) -> Array:
        """Return the derivative (6, 6) of the femorotibial wrench by the rate of the twist.

        As `stiffness`, by the femur's velocity against the insert (m/s, rad/s): of friction,
        which alone depends on it.
        """
        data = self.create_data() if data is None else data
        place = self._kinematics(data, q, v)
        if self.contact is None:
            return np.zeros((6, 6))
        contact = self._contact_at(data, place)
        return self._mirrored_matrix(self.contact.damping(contact, self.bridge.twist(data.data)))

    def relative_jacobian(self, q: Array, data: KneeData | None = None) -> Array:
        """Return J (6, nv): J v is the femoral component's twist against the insert.

        Of its point at the insert's origin, insert frame. So the generalised force of a wrench w
        on the insert (and -w on the femur) is -J^T w, and that of the knee's stiffness K in
        `pin.computeABADerivatives` is -J^T K J.
        """
        data = self.create_data_for_kinematics() if data is None else data
        self._check(q, "q", self.model.nq)
        model, cache = self.model, data.data
        pin.computeJointJacobians(model, cache, q)
        insert = cache.oMi[self.bridge.insert.joint] * self.bridge.insert.placement
        total = np.zeros((6, model.nv))
        for place, sign in ((self.bridge.component, 1.0), (self.bridge.insert, -1.0)):
            if place.joint:
                local = pin.getJointJacobian(model, cache, place.joint, pin.ReferenceFrame.LOCAL)
                total += (
                    sign
                    * insert.actInv(cache.oMi[place.joint]).toActionMatrix()
                    @ local.reshape(6, -1)
                )
        return total

    def inverse_dynamics(
        self,
        q: Array,
        v: Array,
        a: Array,
        external: Any = None,
        tensions: Mapping[str, float] | None = None,
        contact: "ContactResult | None" = None,
        data: KneeData | None = None,
    ) -> KneeLoads:
        """Return the loads of the knee that a motion asks for.

        The shank's and the patella's equations of motion, for as many unknown loads (see
        docs/equilibrium.md). Ligaments and given muscles are known, contact points are the
        closest points of the undeformed bodies.

        Args:
            q: (nq,).
            v: (nv,).
            a: (nv,).
            external: forces on the joints, each in its joint's frame, as `fext` of `pin.rnea`:
                the ground reaction, and all else that acts on the shank. None: nothing does.
            tensions: muscle of `muscles` -> N. The quadriceps is what is sought.
            contact: its resultants take the place of the closest points.
            data: from `create_data`, to save time.

        Returns:
            The loads; a state without a solution holds NaN and says why in `problems`.

        Raises:
            InputError: an argument of the wrong size, an unknown muscle, or a contact given to a
                knee without a contact model.
        """
        data = self.create_data_for_kinematics() if data is None else data
        instant = self._instant(q, v, a, external, tensions, data)
        geometry = instant.geometry(0)
        points = NO_CONTACT
        if contact is not None:
            from tkamb.contact.probe import condyle_wrenches

            wrenches = condyle_wrenches(contact, self._need_contact().pair.split)
            condyles = instant.resultants(0, instant.coordinates, wrenches)
            off = frozenset(instant.sides - set(condyles))
            points = replace(NO_CONTACT, condyles=condyles, lifted=off)
        elif self.contact is not None:
            points = contact_points(
                self.query,
                knee_pose(instant.coordinates),
                lambda point: instant.sliding(0, instant.coordinates, point),
            )
        problems = points.problems + geometry.problems
        geometry = replace(
            geometry, condyles=points.condyles, lifted=points.lifted, problems=problems
        )
        return self._solved(geometry, data)

    def press(
        self,
        q: Array,
        load: float,
        guess: "Guess | None" = None,
    ) -> "ContactResult":
        """Return the contact when the femur carries a load, at the rotation, AP and ML of q.

        Args:
            q: (nq,).
            load: N, along the insert's y axis, pressing; not negative.
            guess: an earlier result or warm start, to save time.

        Returns:
            Pressure, area and forces of both condyles, in the insert frame of a right knee: a
            left knee is computed as its mirror image (z to -z).

        Raises:
            InputError: no contact model, or a load that is negative or not finite.
        """
        return self.press_from(q, load, guess)[0]

    def press_from(
        self, q: Array, load: float, start: "Guess | None" = None
    ) -> "tuple[ContactResult, WarmStart]":
        """Return what `press` does, and the warm start of a press near by.

        Args:
            q: (nq,).
            load: N, as of `press`.
            start: the warm start that the last press returned; it saves time.
        """
        contact = self._need_contact()
        if not (np.isfinite(load) and load >= 0):
            raise InputError(f"load {load} N", "press", "give a load of 0 or more")
        place = self._kinematics(self.create_data_for_kinematics(), q)
        return contact.model.press_from(contact.state, float(load), place.pose, start)

    def evaluate(self, q: Array, guess: "Guess | None" = None) -> "ContactResult":
        """Return the contact at q: pressure, area and forces by the overlap of the bodies there.

        As `press`, but for the height, which is that of q.
        """
        contact = self._need_contact()
        place = self._kinematics(self.create_data_for_kinematics(), q)
        return contact.model.evaluate(contact.state, place.pose, guess)

    def equilibrium(
        self,
        q: Array,
        v: Array,
        a: Array,
        external: Any = None,
        released: Sequence[str] = ("ap", "ml", "axial_rotation", "adduction"),
        tensions: Mapping[str, float] | None = None,
        data: KneeData | None = None,
    ) -> Equilibrium:
        """Return the pose at which the released coordinates are in equilibrium, with its loads.

        Flexion stays as in q, and so do the coordinates that are not released; the
        superior-inferior position always follows from the contact. The shank moves as q, v and a
        say, and the search is quasi-static for the released coordinates (docs/equilibrium.md).

        Args:
            q: (nq,), where the search begins.
            v: (nv,).
            a: (nv,).
            external: see `inverse_dynamics`.
            released: of "ap", "ml", "axial_rotation", "adduction" ("si" is understood).
            tensions: see `inverse_dynamics`.
            data: from `create_data`, to save time.

        Raises:
            InputError: an unknown coordinate, no contact model, or a knee of the model with too
                few degrees of freedom to reach the pose.
            ComputationError: the femur does not lie over the insert.
        """
        from tkamb.knee.equilibrium.released import ReleasedKnee

        contact, allowed = self._need_contact(), [n for n in KNEE_COORDINATES if n != "flexion"]
        for name in released:
            if name not in allowed:
                raise InputError(f"no coordinate '{name}'", "released", names_near(name, allowed))
        data = self.create_data() if data is None else data
        instant = self._instant(q, v, a, external, tensions, data)
        probe = data.probe if data.probe is not None else contact.probe()
        search = ReleasedKnee(instant, probe, released)  # type: ignore[arg-type]
        points = {} if len(search.released) == 5 else self._nearest_points(instant)
        knee = self._rest(search, instant, points)
        loads, result, q_end = None, None, np.array(q, float)
        if not knee.problem:
            q_end = self._configuration(q, knee_pose(knee.coordinates))
            pin.forwardKinematics(self.model, data.data, q_end)
            result = contact.model.evaluate(contact.state, knee_pose(knee.coordinates))
            geometry = self._loaded(knee, instant, points)
            loads = self._solved(geometry, data)
        if loads is None:
            unsolvable = replace(knee.geometry, problems=(knee.problem,))
            loads = self._solved(unsolvable, data)
        left_over = float(np.abs(knee.balance.force).max())
        return Equilibrium(
            q_end,
            knee.coordinates,
            loads,
            result,
            left_over,
            knee.balance.stiffness,
            knee.problem,
            knee,
        )

    def show(self, viewer: Any, q: Array, **options: Any) -> None:
        """Draw the knee at q in a user's `pin.visualize.MeshcatVisualizer`.

        Adds implant, ligaments, lines, force arrows and the pressure map below the viewer's root
        node; see `tkamb.knee.show.show_knee` for the options.
        """
        from tkamb.knee.show import show_knee

        show_knee(self, viewer, q, **options)

    def live(self, q: Array, load: float = 1000.0, folder: Any = None) -> Any:
        """Serve a page on which the knee is pressed and moved by hand; see docs/live.md.

        The load acts along the insert's y axis; ligaments between femur and tibia pull. Nothing
        that is done there changes this object.

        Args:
            q: (nq,), or (f, nq) for the slider "recorded frame".
            load: N, at first.
            folder: for what is kept; None: out/live.

        Returns:
            The server: its address is `url`, and it answers until `close()`.

        Raises:
            InputError: no contact model, or one without a name (`tkamb.contact_model`).
        """
        return import_module("tkamb.show.view.knee_on_bench").live_knee(self, q, load, folder)

    def at(self, q: Array, data: KneeData) -> KneePlace:
        """Return where the knee is at q, and bring the placements in `data` up to date."""
        return self._kinematics(data, q)

    def link_poses(self, q: Array, femur: Array, data: KneeData) -> tuple[dict[str, Array], bool]:
        """Return link -> pose (4, 4) in the insert frame, of a right knee.

        Args:
            q: (nq,), which places a patella of the model.
            femur: (4, 4) of the femoral component in the insert frame.
            data: from `create_data`.

        Returns:
            The poses, and whether the patella is among them; not where it is found nowhere.
        """
        place, patella = replace(self._kinematics(data, q), pose=femur), None
        if self.extensor is not None:
            try:
                patella = self._find_patella(place, data)
            except ComputationError:
                patella = None
        return self._link_poses(place, patella), patella is not None

    def extensor_paths(self, poses: dict[str, Array]) -> dict[str, Array]:
        """Return quadriceps and patellar ligament as they run (n, 3) m, insert frame.

        Empty without an extensor mechanism, or where the patella is found nowhere.
        """
        if self._extensor_lines is None or "patella" not in poses:
            return {}
        muscle, ligament = self._extensor_lines.paths(_Posed(poses))
        return {self._extensor_lines.muscle.name: muscle.points, PATELLAR_LIGAMENT: ligament.points}

    @property
    def query(self) -> "ClosestPointQuery":
        """Closest points of femoral component and insert, made when first asked for."""
        if self._query is None:
            from tkamb.geometry.closest import ClosestPointQuery

            contact = self._need_contact()
            pair = contact.pair
            self._query = ClosestPointQuery(pair.femoral, pair.insert, pair.split)
        return self._query

    # -- building --

    def _surfaces(
        self, is_left: bool, contact: object, extensor: object
    ) -> "tuple[Surface | None, Surface | None, Surface | None]":
        """Return femoral component, insert and button, those of a right knee.

        Raises:
            InputError: one that is needed is missing or cannot be used.
        """
        implant = self.implant
        needs = {"femoral": contact is not None or extensor is not None}
        needs |= {"insert": contact is not None, "patella": extensor is not None}
        surfaces: list[Surface | None] = []
        for name, needed in needs.items():
            mesh = getattr(implant, name)
            if mesh is None and needed:
                what = "[the contact]" if name == "insert" else "the contact or the extensor"
                raise InputError(f"has no {name} mesh", "Implant", f"{what} needs it")
            if mesh is None:
                surfaces.append(None)
                continue
            surface = as_surface(mesh, f"{name} mesh", closed=name == "insert")
            surfaces.append(mirrored_surface(surface) if is_left else surface)
        return surfaces[0], surfaces[1], surfaces[2]

    def _insert_place(self, is_left: bool) -> Place:
        """Return the insert frame on the tibia, and move the insert into it."""
        place = self.anatomy.insert
        if self.insert is None or self.implant.placed:
            return place
        from tkamb.geometry.flat_bottom import insert_placement

        placement = insert_placement(self.insert)
        if np.abs(placement - np.eye(4)).max() < KNEE.frame_tolerance:
            return place
        self.insert = self.insert.moved(placement)
        mesh_in_insert = mirrored_pose(placement) if is_left else placement
        return Place(place.joint, place.placement * se3(inverse(mesh_in_insert)))

    def _bundle(self, bundle: "Ligament") -> "Ligament":
        ends = [self.bridge.link_point(link_point(end)) for end in (bundle.proximal, bundle.distal)]
        if not bundle.slack_length > 0:
            raise InputError(
                f"slack length {bundle.slack_length} m",
                f"ligament {bundle.name}",
                "give slack_length in metres",
            )
        return replace(bundle, proximal=ends[0], distal=ends[1])

    def _divided(self) -> "tuple[BundleArrays | None, tuple[Ligament, ...]]":
        """Return the bundles between femur and tibia, and the others.

        The ends of the first are in the femoral and the insert frame.
        """
        across = [
            bundle
            for bundle in self.ligaments
            if {bundle.proximal.link, bundle.distal.link} == {"femur", "tibia"}
        ]
        others = tuple(bundle for bundle in self.ligaments if bundle not in across)
        if not across:
            return None, others
        from tkamb.knee.ligaments import BundleArrays

        shank = inverse(self.chain.insert_in_tibia)
        ends: dict[str, list[Array]] = {"femur": [], "tibia": []}
        for bundle in across:
            for end in (bundle.proximal, bundle.distal):
                at = transform(shank, end.position) if end.link == "tibia" else end.position
                ends[end.link].append(at)
        bundles = BundleArrays.of(across, np.array(ends["femur"]), np.array(ends["tibia"]))
        return bundles, others

    def _line(self, muscle: Muscle) -> _Line:
        points = [link_point(point) for point in muscle.points]
        if len(points) < 2 or muscle.wrap is not None:
            raise InputError(
                "is no straight line over two points or more",
                f"muscle {muscle.name}",
                "give its points; a quadriceps that wraps belongs to extensor=",
            )
        places = tuple(self.anatomy.frame(point.link) for point in points)
        return _Line(places, tuple(point.position for point in points))

    def _build_extensor(self, extensor: Extensor, is_left: bool) -> Any:
        from tkamb.knee.extensor import ExtensorLines, ExtensorParts
        from tkamb.knee.muscles import check_muscles

        assert self.femoral is not None and self.button is not None
        muscle, ligament = extensor.quadriceps, extensor.patellar_ligament
        points = tuple(self.bridge.link_point(link_point(point)) for point in muscle.points)
        wrap = muscle.wrap
        if wrap is not None and wrap.bone is not None:
            bone = as_surface(wrap.bone, "bone mesh")
            to_component = self.bridge.component.placement.inverse() * self.anatomy.femur.placement
            pose = to_component.homogeneous
            if is_left:
                bone, pose = mirrored_surface(bone), mirrored_pose(pose)
            wrap = replace(wrap, bone=bone.moved(pose))
        muscle = replace(muscle, points=points, wrap=wrap)
        check_muscles([muscle], self.chain)
        ends = [self.bridge.link_point(link_point(p)) for p in (ligament.proximal, ligament.distal)]
        ligament = replace(ligament, proximal=ends[0], distal=ends[1])
        if self._finds_patella and not ligament.length > 0:
            raise InputError(
                "has no length", "patellar ligament", "the place of the patella follows from it"
            )
        parts = ExtensorParts(muscle, ligament, self.chain, self.femoral, self.button, self.insert)
        return ExtensorLines(parts)

    def _build_contact(self, contact: "ContactModel | str", cache: bool) -> "KneeContact":
        from tkamb.contact.pair import ContactPair
        from tkamb.contact.registry import contact_model
        from tkamb.knee.contact import KneeContact

        model = contact_model(contact) if isinstance(contact, str) else contact
        if hasattr(model, "cache") and not cache:
            model = replace(model, cache=False)  # type: ignore[type-var]
        assert self.femoral is not None and self.insert is not None
        implant = self.implant
        pair = ContactPair(self.femoral, self.insert, implant.insert_material, implant.bearing)
        return KneeContact(model, pair, self.friction)

    # -- one instant --

    def _check(self, values: Array, name: str, size: int) -> Array:
        array = np.asarray(values, float)
        if array.shape != (size,):
            raise InputError(f"{name} has the shape {array.shape}", "Knee", f"give ({size},)")
        return array

    def _kinematics(self, data: KneeData, q: Array, v: Array | None = None) -> KneePlace:
        q = self._check(q, "q", self.model.nq)
        if v is None:
            pin.forwardKinematics(self.model, data.data, q)
        else:
            v = self._check(v, "v", self.model.nv)
            pin.forwardKinematics(self.model, data.data, q, v)
        return self.bridge.place(data.data)

    def _contact_at(self, data: KneeData, place: KneePlace) -> "ProbedContact":
        """Return the contact at a place; the last one is remembered in the caller's data."""
        key = place.pose.tobytes()
        if data.seen is None or data.seen[0] != key:
            assert self.contact is not None
            data.seen = key, self.contact.at(data.probe, place.pose)
        return data.seen[1]

    def _need_contact(self) -> "KneeContact":
        if self.contact is None:
            raise InputError("has no contact model", "Knee", "give contact= and implant=")
        return self.contact

    @property
    def _finds_patella(self) -> bool:
        """Whether the place of the patella is found, and not that of q."""
        return self.anatomy.patella is None

    def _pulls(self, tensions: Mapping[str, float]) -> bool:
        return self.extensor is not None and tensions.get(self.extensor.quadriceps.name, 0.0) != 0

    def _tensions(self, tensions: Mapping[str, float] | float | None) -> dict[str, float]:
        """Return muscle -> N.

        Raises:
            InputError: an unknown muscle, or a tension that is negative or not finite.
        """
        own = [self.extensor.quadriceps.name, PATELLAR_LIGAMENT] if self.extensor else []
        if tensions is None:
            return {}
        if not isinstance(tensions, Mapping):
            if not own:
                raise InputError("has no quadriceps", "tensions", "give extensor=, or names")
            tensions = {own[0]: tensions}
        for name, tension in tensions.items():
            if name not in (*own, *self._lines):
                raise InputError(
                    f"no muscle '{name}'", "tensions", names_near(name, [*own, *self._lines])
                )
            if not (np.isfinite(tension) and tension >= 0.0):
                raise InputError(f"tension {tension} N", f"muscle {name}", "a muscle only pulls")
        return {name: float(tension) for name, tension in tensions.items()}

    def _find_patella(self, place: KneePlace, data: KneeData) -> "PatellaState":
        lines = self._extensor_lines
        if self._finds_patella:
            data.patella = solution = lines.solved(place.pose, data.patella)
        else:
            assert place.patella is not None
            solution = lines.given(place.pose, place.patella)
        if not solution.status.found:
            raise ComputationError(f"patella lost: {solution.status.value}", "extensor")
        return solution

    def _link_poses(self, place: KneePlace, patella: "PatellaState | None") -> dict[str, Array]:
        """Return link -> pose (4, 4) in the insert frame."""
        poses = {
            "femur": place.pose,
            "tibia": inverse(self.chain.insert_in_tibia),
            "insert": np.eye(4),
        }
        if patella is not None:
            joint = self.chain.patella_joint_in_femur
            poses["patella"] = place.pose @ joint @ _in_plane(patella.coordinates)
        return poses

    def _extensor_pull(
        self,
        poses: dict[str, Array],
        place: KneePlace,
        patella: "PatellaState",
        tensions: Mapping[str, float],
    ) -> list[PointForces]:
        """Return what a tension of the quadriceps does, the patella massless.

        Raises:
            ComputationError: the patella cannot carry it on.
        """
        assert self.extensor is not None
        tension = tensions.get(self.extensor.quadriceps.name, 0.0)
        extensor, muscle = self._extensor_lines.loads(place.coordinates[5], _Posed(poses), patella)
        point, normal = patella.contact_point[None], patella.contact_normal
        patellar_tension = tensions.get(PATELLAR_LIGAMENT)
        if patellar_tension is not None:
            pulls = [
                *_scaled(muscle.loads, tension),
                *_scaled(extensor.patellar_ligament, patellar_tension),
            ]
            pull = sum(load.forces.sum(axis=0) for load in pulls if load.link == "patella")
            across = poses["femur"][:3, 2]
            force = -(pull - (pull @ across) * across)
        else:
            if not (patella.ligament_ratio > 0.0 and patella.patellofemoral_ratio > 0.0):
                raise ComputationError(
                    "the contact would have to pull, or the patellar ligament to push", "extensor"
                )
            pulls = [
                *_scaled(muscle.loads, tension),
                *_scaled(extensor.patellar_ligament, tension * patella.ligament_ratio),
            ]
            force = tension * patella.patellofemoral_ratio * normal
        return [
            *pulls,
            PointForces("patella", point, force[None]),
            PointForces("femur", point, -force[None]),
        ]

    def _with_lines(self, data: KneeData, tensions: Mapping[str, float], *parts: Any) -> Any:
        """Return the sum of forces on the joints, and of the muscles' lines."""
        forces = [pin.Force.Zero() for _ in range(self.model.njoints)]
        for part in parts:
            if part is not None:
                forces = [one + other for one, other in zip(forces, part, strict=True)]
        for name, line in self._lines.items():
            tension = tensions.get(name, 0.0)
            if tension == 0.0:
                continue
            placements = [data.data.oMi[place.joint] for place in line.places]
            at = [
                placement.act(place.placement.act(position))
                for placement, place, position in zip(
                    placements, line.places, line.positions, strict=True
                )
            ]
            steps = np.diff(np.array(at), axis=0)
            along = steps / np.linalg.norm(steps, axis=1, keepdims=True)
            pulls = tension * np.concatenate([along[:1], np.diff(along, axis=0), -along[-1:]])
            for placement, place, point, pull in zip(
                placements, line.places, at, pulls, strict=True
            ):
                forces[place.joint] += placement.actInv(pin.Force(pull, cross(point, pull)))
        return pin.StdVec_Force(forces)

    def _ligament_stiffness(self, place: KneePlace) -> Array:
        """Return the derivative (6, 6) of the wrench of the bundles between femur and tibia."""
        if self._crossing is None:
            return np.zeros((6, 6))
        from tkamb.knee.contact import DifferenceSettings, batch_differences

        return batch_differences(self._crossing.wrench, place.pose, DifferenceSettings(step=1e-7))

    def _mirrored_matrix(self, matrix: Array) -> Array:
        if not self.left:
            return matrix
        return mirrored_spatial(mirrored_spatial(matrix).T).T

    def _instant(
        self,
        q: Array,
        v: Array,
        a: Array,
        external: Any,
        tensions: Mapping[str, float] | None,
        data: KneeData,
    ) -> Instant:
        """Return the knee at one instant, muscles of given tension among what is external."""
        q, v, a = (
            self._check(values, name, size)
            for values, name, size in (
                (q, "q", self.model.nq),
                (v, "v", self.model.nv),
                (a, "a", self.model.nv),
            )
        )
        if external is not None and len(external) != self.model.njoints:
            raise InputError(
                f"{len(external)} forces", "external", f"give one per joint, {self.model.njoints}"
            )
        pulled = self._tensions(tensions)
        if self._pulls(pulled):
            raise InputError(
                "the quadriceps is what is sought", "tensions", "give other muscles' alone"
            )
        pin.forwardKinematics(self.model, data.data, q, v, a)
        if pulled:
            external = self._with_lines(data, pulled, external)
        bridge, pin_data = self.bridge, data.data
        chain_motion = bridge.motion(pin_data, self.extensor is not None)
        patella = None
        if self.extensor is not None:
            joints = None if self._finds_patella else chain_motion.joints[0, 6:]
            place = knee_pose(chain_motion.joints[0, :6])
            patella = PatellaAt(self._extensor_lines, place, joints, self.extensor.solved)
        return Instant(
            self.chain,
            chain_motion,
            bridge.shank_needs(pin_data, external),
            bridge.external_on(self.anatomy.femur, pin_data, external),
            bridge.external_on(self.anatomy.patella, pin_data, external),
            self.ligaments,
            patella,
            self.friction,
            self.contact is not None and self.contact.pair.split is not None,
        )

    def _solved(self, geometry: KneeGeometry, data: KneeData) -> KneeLoads:
        """Return the loads of a geometry, and what they do to the user's joints."""
        if geometry.problems:
            loads, unknowns = unsolved(geometry.problems), []
        else:
            loads = solve_knee(geometry, self.friction)
            unknowns = [] if loads.problems else solved_unknowns(geometry, loads, self.friction)
        groups: dict[str, list[PointForces]] = {"external": [], "residual": [], "hip": []}
        if unknowns:
            groups["external"] += geometry.ligaments
        for unknown in unknowns:
            group = unknown.name.split("_")[0]
            group = group if group in groups else "external"
            groups[group] += _scaled(unknown.loads, loads.values[unknown.name])
        forces = {
            name: self.bridge.joint_forces(data.data, group) for name, group in groups.items()
        }
        return knee_loads(geometry, loads, self.left, forces)

    # -- equilibrium --

    def _nearest_points(self, instant: Instant) -> dict[str, Array]:
        gaps = self.query.at(knee_pose(instant.coordinates))
        centres = {"medial": gaps.medial.centre}
        return centres | ({"lateral": gaps.lateral.centre} if gaps.lateral else {})

    def _rest(self, search: Any, instant: Instant, points: dict[str, Array]) -> "KneeEquilibrium":
        """Return the knee at rest, from first touch at the other coordinates of q."""
        from tkamb.knee.equilibrium.starts import InitialPoses

        pair, recorded = self._need_contact().pair, instant.coordinates
        if not np.isfinite(pair.first_touch_height(knee_pose(recorded))):
            raise ComputationError("the femoral component does not lie over the insert", "q")
        return InitialPoses(recorded[None], search, pair, None).rest(0, (), points)

    def _loaded(
        self, knee: "KneeEquilibrium", instant: Instant, points: dict[str, Array]
    ) -> KneeGeometry:
        """Return the geometry at rest with the contact's resultants in it."""
        up, still = np.array([0.0, 1.0, 0.0]), np.zeros(3)
        separated = {
            side: CondylePoint(point, up, still, float("nan")) for side, point in points.items()
        }
        touching = instant.resultants(0, knee.coordinates, knee.contact.condyles)
        lifted = frozenset(instant.sides - set(touching))
        return replace(knee.geometry, condyles=separated | touching, lifted=lifted)

    def _configuration(self, q: Array, target: Array) -> Array:
        """Return q with the knee's joints moved so that the femur has a pose (4, 4).

        Newton's method on the joints between tibia and femur.

        Raises:
            InputError: these joints cannot make that pose.
        """
        model, data = self.model, self.model.createData()
        target_placement = se3(mirrored_pose(target) if self.left else target)
        columns = [
            model.joints[joint].idx_v + k
            for joint in self.anatomy.knee_joints
            for k in range(model.joints[joint].nv)
        ]
        q = np.array(q, float)
        for _ in range(KNEE.max_pose_steps):
            pin.forwardKinematics(model, data, q)
            insert = data.oMi[self.bridge.insert.joint] * self.bridge.insert.placement
            femur = data.oMi[self.bridge.component.joint] * self.bridge.component.placement
            error = pin.log6(target_placement * insert.actInv(femur).inverse()).vector
            if np.abs(error).max() < KNEE.pose_tolerance:
                return q
            jacobian = self.relative_jacobian(q)[:, columns]
            step = np.zeros(model.nv)
            step[columns] = np.linalg.lstsq(jacobian, error, rcond=None)[0]
            q = pin.integrate(model, q, step)
        if np.abs(error).max() < KNEE.accepted_pose_error:
            return q
        raise InputError(
            f"the {knee_size(self.anatomy)} degrees of freedom between tibia and femur do not "
            "reach the pose of equilibrium",
            "Knee",
            "give the knee of the model six (a pin.JointModelFreeFlyer, or six single joints)",
        )


class _Posed:
    """Poses of links in the insert frame, as `ExtensorLines` asks for them."""

    def __init__(self, poses: dict[str, Array]) -> None:
        self._poses = poses

    def pose(self, link: str) -> Array:
        """Return pose_link_in_insert (4, 4)."""
        return self._poses[link]


def _scaled(loads: Iterable[PointForces], factor: float) -> list[PointForces]:
    return [
        PointForces(load.link, load.points, factor * load.forces, factor * load.moment)
        for load in loads
    ]


def _in_plane(coordinates: Array) -> Array:
    """Return the patella's pose (4, 4) in its plane's frame at (ap, si, rotation)."""
    ap, si, rotation = coordinates
    c, s = np.cos(rotation), np.sin(rotation)
    result = np.eye(4)
    result[:2, :2], result[:2, 3] = [[c, -s], [s, c]], [ap, si]
    return result
