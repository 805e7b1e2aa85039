"""Contributions of the loads to the condyles' forces: their sum, and statics of the shank."""

from dataclasses import replace

import numpy as np
import pytest

from knees import UP, bent_knee
from shared_trials import two_flexors
from tkamb.knee.crossing import (
    EXTENSORS,
    EXTERNAL,
    LIGAMENTS,
    POST,
    condyle_contributions,
)
from tkamb.knee.load import PointForces, wrench_of
from tkamb.knee.unknowns import AXES
from tkamb.run.muscles.shared_muscles import SharedMuscles

FRICTION = 0.05
GROUND_POINTS = {
    "taut": [-0.06, -0.45, 0.0],
    "slack": [0.06, -0.45, 0.0],
    "one side": [-0.05, -0.45, 0.3],
}


def solved(where, least_activation=0.05):
    """Return geometry and loads of the bent knee with 700 N of ground reaction and ligaments."""
    ground = PointForces("tibia", np.array([GROUND_POINTS[where]]), 700 * UP[None])
    strap = np.array([0.0, 0.01, 0.04]), 90 * UP
    pull = (
        PointForces("tibia", strap[0][None], strap[1][None]),
        PointForces("femur", strap[0][None], -strap[1][None]),
    )
    knee = replace(bent_knee(), ground=ground, ligaments=pull)
    return (
        SharedMuscles(two_flexors(1, reserve=2.0, least=least_activation))
        .frame(0)
        .solve(knee, FRICTION)
    )


@pytest.mark.parametrize("where", GROUND_POINTS)
def test_contributions_add_up_to_the_normal_forces(where):
    geometry, loads = solved(where, least_activation=0.0 if where == "slack" else 0.05)
    assert loads.slack == (where == "slack")
    assert bool(loads.lifted) == (where == "one side")
    parts = condyle_contributions(geometry, loads, FRICTION)
    assert set(parts) == {"medial", "lateral"} - loads.lifted
    names = {EXTERNAL, LIGAMENTS, "hamstring", "gastrocnemius", EXTENSORS}
    for side, causes in parts.items():
        assert set(causes) == names
        assert sum(causes.values()) == pytest.approx(loads.values[f"{side}_normal"], abs=1e-6)


def shank_alone(geometry, wrench):
    """Return the normal forces on the shank that balance a wrench on it, by six equations."""
    contacts = geometry.condyles
    middle = np.mean([one.point for one in contacts.values()], axis=0)
    columns = [wrench_of(c.point, -c.direction(FRICTION)) for c in contacts.values()]
    columns += [wrench_of(middle, AXES[axis]) for axis in ("ap", "ml")]
    columns += [np.concatenate([np.zeros(3), AXES[axis]]) for axis in ("si", "ml")]
    magnitudes = np.linalg.solve(np.array(columns).T, -wrench)
    return dict(zip(contacts, magnitudes[:2], strict=True))


def test_a_flexor_contribution_agrees_with_statics_of_the_shank():
    geometry, loads = solved("taut")
    parts = condyle_contributions(geometry, loads, FRICTION)
    share = geometry.share
    for k, (tibia, _) in zip(share.crossing, share.lines.unit_loads(geometry.state), strict=True):
        pull = share.force[k] * wrench_of(tibia.points[0], tibia.forces[0])
        for side, force in shank_alone(geometry, pull).items():
            assert parts[side][share.muscles[k]] == pytest.approx(force, rel=1e-9)


def on_link(loads, link):
    """Return the wrench (6,) of loads on one link."""
    on_this_link = [load for load in loads if load.link == link]
    return sum(wrench_of(load.points, load.forces).sum(axis=0) for load in on_this_link)


def test_a_cam_on_the_post_is_a_separate_contribution():
    """With a post the terms add up, and the post's term agrees with statics of the shank."""
    point, cam_force = np.array([-0.003, 0.02, 0.004]), np.array([400.0, -60.0, 20.0])
    post = (
        PointForces("tibia", point[None], cam_force[None]),
        PointForces("femur", point[None], -cam_force[None]),
    )
    geometry, _ = solved("taut")
    geometry, loads = (
        SharedMuscles(two_flexors(1, reserve=2.0, least=0.05))
        .frame(0)
        .solve(replace(geometry, post=post), FRICTION)
    )
    parts = condyle_contributions(geometry, loads, FRICTION)
    for side, force in shank_alone(geometry, wrench_of(point, cam_force)).items():
        assert parts[side][POST] == pytest.approx(force, rel=1e-9)
        assert sum(parts[side].values()) == pytest.approx(loads.values[f"{side}_normal"], abs=1e-6)


def test_the_quadriceps_presses_by_the_patellar_ligament_alone():
    """Equilibrium of the patella gives the ligament; that of the shank gives the normal forces."""
    geometry, loads = solved("taut")
    parts = condyle_contributions(geometry, loads, FRICTION)
    extensor, femur = geometry.extensor, geometry.state.pose("femur")
    plane = np.zeros((3, 6))
    plane[:2, :3], plane[2, 3:] = femur[:3, :2].T, femur[:3, 2]
    tangent = np.cross(femur[:3, 2], extensor.contact_normal)
    pushes = [wrench_of(extensor.contact_point, v) for v in (extensor.contact_normal, tangent)]
    pull = on_link(geometry.muscles[0].loads, "patella")
    columns = np.array([on_link(extensor.patellar_ligament, "patella"), *pushes]).T
    per_newton = np.linalg.solve(plane @ columns, -plane @ pull)[0]
    tension = per_newton * extensor.tension(loads.values)
    wrench = tension * on_link(extensor.patellar_ligament, "tibia")
    for side, force in shank_alone(geometry, wrench).items():
        assert parts[side][EXTENSORS] == pytest.approx(force, rel=1e-9)
