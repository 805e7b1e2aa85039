"""A scene as a knee, its motion and its ground reaction: `tkamb.read_scene`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from tkamb.geometry.frames import Array
from tkamb.io.scene import Scene, load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.knee.knee import Knee
from tkamb.knee.parts import Extensor, Implant
from tkamb.run.mechanics import Mechanics


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of a model, frame by frame.

    Args:
        time: (f,) s.
        q: (f, nq) configuration.
        v: (f, nv) velocity.
        a: (f, nv) acceleration.
    """

    time: Array
    q: Array
    v: Array
    a: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class Ground(Sequence[Any]):
    """The ground reaction, frame by frame, as external forces on the joints of a model.

    Args:
        forces: (f,) of `pin.StdVec_Force`, one force per joint in its joint's frame.
    """

    forces: tuple[Any, ...]

    def __len__(self) -> int:
        return len(self.forces)

    def __getitem__(self, k: Any) -> Any:
        return self.forces[k]


def read_scene(scene: Scene | Case | str | Path) -> tuple[Knee, Motion, Ground]:
    """Return the knee of a scene, its motion and the ground reaction, as arrays.

    The knee's model is the scene's leg with a free root at the tibia, x forward, y up, z to the
    right. A left leg is read as its mirror image, a right one, as in every run. The place of a
    patella whose motion is to be found is found here, frame after frame, and is part of q.

    Args:
        scene: a scene, the path of its file, or its case.

    Raises:
        InputError: the scene or a file that it names cannot be used.
    """
    if isinstance(scene, str | Path):
        scene = load_scene(scene)
    case = scene if isinstance(scene, Case) else load_case(scene)
    mechanics = Mechanics(case)
    count = len(case.motion.time)
    states = [case.chain.configuration(mechanics.chain_motion(k)) for k in range(count)]
    q, v, a = (np.array(values) for values in zip(*states, strict=True))
    knee = _knee(case, mechanics)
    ground = tuple(_external(case, mechanics, knee.model, q[k], k) for k in range(count))
    return knee, Motion(case.motion.time, q, v, a), Ground(ground)


def _knee(case: Case, mechanics: Mechanics) -> Knee:
    scene, contact, extensor = case.scene, None, None
    table, insert = scene.contact, scene.implant.insert
    implant = Implant(case.femoral, case.insert, case.patella, placed=True)
    if table is not None:
        from tkamb.contact.registry import contact_model

        assert insert is not None
        contact = contact_model(table.model, table.resolution_mm, **table.options)
        implant = Implant(
            case.femoral, case.insert, case.patella, table.material, insert.bearing, placed=True
        )
    if scene.patella is not None:
        (muscle,) = case.muscles
        assert case.patellar_ligament is not None
        solved = scene.patella.motion == "solved"
        extensor = Extensor(muscle, case.patellar_ligament, solved=solved)
    return Knee(
        case.chain.model,
        implant=implant,
        ligaments=mechanics.ligaments,
        extensor=extensor,
        contact=contact,
        friction=mechanics.friction,
        cache=True,
    )


def _external(case: Case, mechanics: Mechanics, model: pin.Model, q: Array, k: int) -> Any:
    """Return the ground reaction of frame k as forces on the joints."""
    forces = [pin.Force.Zero() for _ in range(model.njoints)]
    load = mechanics.ground_in_laboratory(k)
    if load is not None:
        force, point, moment = load
        data = model.createData()
        pin.forwardKinematics(model, data, q)
        joint = model.frames[case.chain.frame_id("tibia")].parentJoint
        wrench = pin.Force(force, moment + np.cross(point, force))
        forces[joint] = data.oMi[joint].actInv(wrench)
    return pin.StdVec_Force(forces)
