"""Inverse dynamics of OpenSim models: energy, momentum, and OpenSim's own generalised forces."""

import numpy as np
import pytest

from opensim_models import PUBLISHED, kinematics
from opensim_references import references
from tkamb.io.opensim.motion import inverse_dynamics

TOLERANCE = {"JW": 1e-8, "gait2392": 1e-8, "DM": 5e-3, "Rajagopal2016": 0.05}
"""N and N·m. OpenSim's own error is this large where splines rotate a joint, see
`test_force_on_the_pelvis_is_the_rate_of_momentum`."""


def energy(chain, q, rates):
    """Return kinetic and potential energy (f,) from the bodies' own motion."""
    motion = chain.motion(q)
    twists = np.einsum("fbin,fn->fbi", motion.twists, rates)
    total = np.zeros(len(q))
    for name, body in chain.model.bodies.items():
        b = chain.bodies[name]
        rotation = motion.poses[:, b, :3, :3]
        centre = rotation @ body.centre + motion.poses[:, b, :3, 3]
        omega = np.einsum("fji,fj->fi", rotation, twists[:, b, :3])
        speed = twists[:, b, 3:] + np.cross(twists[:, b, :3], centre)
        total += 0.5 * np.einsum("fi,ij,fj->f", omega, body.inertia, omega)
        total += body.mass_kg * (0.5 * (speed**2).sum(1) - centre @ chain.model.gravity)
    return total


@pytest.mark.parametrize("name", ["old_layout", "JW"])
def test_power_is_the_rate_of_energy(name):
    """The power of generalised forces and of a wrench on the foot is the rate of the energy."""
    chain = kinematics(name)
    rng = np.random.default_rng(2)
    q, rates, second = rng.uniform(-0.8, 0.8, (3, 3, len(chain.coordinates)))
    foot = "calcn" if name == "old_layout" else "calcaneus"
    foot = foot if foot in chain.bodies else list(chain.bodies)[-1]
    wrench = {foot: rng.uniform(-50.0, 50.0, (3, 6))}
    forces = inverse_dynamics(chain, q, rates, second, wrench)
    twist = np.einsum("fin,fn->fi", chain.motion(q).twists[:, chain.bodies[foot]], rates)
    power = (forces * rates).sum(1) + (wrench[foot] * twist).sum(1)
    h = 1e-5
    ahead, behind = (
        energy(chain, q + s * rates + 0.5 * s**2 * second, rates + s * second) for s in (h, -h)
    )
    np.testing.assert_allclose((ahead - behind) / (2 * h), power, rtol=1e-7, atol=1e-5)


@pytest.mark.parametrize("name", ["Rajagopal2016", "DM"])
def test_force_on_the_pelvis_is_the_rate_of_momentum(name):
    """The force agrees with differences of the mass centre's path; OpenSim is up to 0.03 N off."""
    chain, truth = kinematics(name), references()[name]
    rates, second, _ = (np.array([v]) for v in truth["dynamics"][1])
    q, model = np.array(truth["q"][1:2]), chain.model

    def first_moment(at):
        poses = chain.poses(at)
        return sum(
            body.mass_kg * (poses[0, chain.bodies[n]] @ np.append(body.centre, 1.0))[:3]
            for n, body in model.bodies.items()
        )

    h = 2e-4
    path = [first_moment(q + s * rates + 0.5 * s**2 * second) for s in h * np.arange(-2, 3)]
    expected_rate = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) @ path / (12.0 * h**2)
    forces = inverse_dynamics(chain, q, rates, second)[0]
    pelvis = [chain.coordinates[f"pelvis_t{axis}"] for axis in "xyz"]
    expected = expected_rate - model.mass_kg * model.gravity
    np.testing.assert_allclose(forces[pelvis], expected, atol=1e-4)


@pytest.mark.parametrize("name", PUBLISHED)
def test_generalised_forces_are_those_of_opensim(name):
    chain, truth = kinematics(name), references()[name]
    count = len(truth["dynamics"])
    rates, second, forces = (np.array(v) for v in zip(*truth["dynamics"], strict=True))
    computed = inverse_dynamics(chain, np.array(truth["q"])[:count], rates, second)
    np.testing.assert_allclose(computed, forces, atol=TOLERANCE[name])
