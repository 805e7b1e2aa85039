"""A whole trial beside OpenSim's tools: inverse dynamics, static optimisation, knee reaction.

The same model, coordinates, plates, cost (Σa², isometric muscles) and reserves. OpenSim's
optimiser sometimes stops at a feasible point that is not the minimum, with 80 times the minimum
cost in one frame of this trial. The tests recognise such frames by their cost and skip them.
"""

from dataclasses import replace

import numpy as np
import pytest

from jw_gait import gait, needs_jw
from tkamb.io.opensim.motion import inverse_dynamics
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.filtering import differentiate_coordinates
from tkamb.run.muscles import Sharing, solve_trial
from tkamb.run.muscles.sharing import FrameProblems

RESERVE = 10.0
SHARING = Sharing(reserve=RESERVE, weights="equal")


@pytest.fixture(scope="module")
def tools(tmp_path_factory):
    pytest.importorskip("opensim", reason="the package opensim (4.6) is not installed")
    from opensim_tools import Tools

    return Tools(gait(2.2, 2.75), tmp_path_factory.mktemp("opensim"))


@needs_jw
def test_generalised_forces_of_a_trial_are_those_of_opensims_tool(tools):
    trial = tools.trial
    motion, chain = trial.motion, trial.kinematics
    reference = tools.inverse_dynamics()
    result = inverse_dynamics(chain, motion.q, motion.rates, motion.accelerations, trial.loads)
    assert np.abs(reference).max() > 500.0
    np.testing.assert_allclose(result, reference, atol=0.1)
    # The spline of tkamb has other end conditions, which matter only near the ends.
    second = differentiate_coordinates(motion.time, motion.q, "none")
    result = inverse_dynamics(chain, *second, trial.loads)
    np.testing.assert_allclose(result[8:-8], reference[8:-8], atol=0.1)


class Compared:
    """Results at some frames: `result` of tkamb, `reference` and `reaction` of OpenSim."""

    def __init__(self, tools, wraps, every):
        trial = tools.trial
        time, model = trial.motion.time, trial.kinematics.model
        names = solve_trial(model, trial.motion, trial.loads).muscles
        balanced = ("hip_flexion", "hip_adduction", "hip_rotation")
        balanced += ("knee_flexion", "ankle_angle", "subtalar_angle")
        path = tools.write_model(names, dict.fromkeys(balanced, RESERVE), wraps)
        self.result = solve_trial(read_osim(path), trial.motion, trial.loads, sharing=SHARING)
        self.span = float(time[0]), float(time[-1]), every
        activations, self.seconds = tools.static_optimisation(*self.span)
        self.frames = [int(np.argmin(np.abs(time - t))) for t in activations["time"]]
        self.reference = np.stack([activations[name] for name in self.result.muscles], axis=1)
        reserve = np.stack([activations[f"reserve_{name}"] for name in balanced], axis=1)
        least = (self.result.activation**2).sum(1) + (self.result.reserve**2).sum(1) / RESERVE**2
        self.excess = ((self.reference**2).sum(1) + (reserve**2).sum(1)) / least[self.frames]
        self.optimal = self.excess < 1.1
        reaction, _ = tools.knee_reaction(*self.span)
        stem = "tibial_tray_weld_on_tibia_in_ground_f"
        self.reaction = np.stack([reaction[stem + axis] for axis in "xyz"], axis=1)

    def rms(self, activation):
        """Return the root mean square difference of activations (k, m) at the frames."""
        return float(np.sqrt(np.mean((activation - self.reference)[self.optimal] ** 2)))

    def tkamb_reaction(self, force_N=None):
        """Return the force on the tibia at the frames in ground (k, 3), of any muscle forces."""
        result = self.result if force_N is None else replace(self.result, force_N=force_N)
        pose = result.bones.poses[:, result.bones.index("tibia"), :3, :3]
        force = np.einsum("fij,fj->fi", pose, result.knee_reaction()[:, 3:])
        return force[self.frames]


@needs_jw
def test_activations_and_knee_reaction_are_those_of_opensim_on_straight_lines(tools):
    comparison = Compared(tools, wraps=False, every=22)
    assert comparison.optimal.all()
    assert comparison.rms(comparison.result.activation[comparison.frames]) < 0.002
    errors = np.linalg.norm(comparison.tkamb_reaction() - comparison.reaction, axis=1)
    assert (errors / np.linalg.norm(comparison.reaction, axis=1)).max() < 0.01


@needs_jw
@pytest.mark.slow
def test_wrapped_lines_differ_by_their_moment_arms_alone(tools):
    comparison = Compared(tools, wraps=True, every=6)
    result = comparison.result
    assert comparison.optimal.mean() > 0.8
    assert comparison.rms(result.activation[comparison.frames]) < 0.02
    muscles = [tools.trial.kinematics.model.muscles[name] for name in result.muscles]
    strength = np.array([muscle.max_isometric_force_N for muscle in muscles])
    force = np.zeros_like(result.force_N)
    force[comparison.frames] = comparison.reference * strength
    errors = np.linalg.norm(comparison.tkamb_reaction(force) - comparison.reaction, axis=1)
    assert errors.max() < 0.02 * np.linalg.norm(comparison.reaction, axis=1).max()
    reference = tools.moment_arms(result.coordinates, *comparison.span)
    arms = np.stack(
        [np.stack([reference[c][m] for m in result.muscles], axis=1) for c in result.coordinates],
        axis=2,
    )
    shape = len(comparison.frames), len(muscles)
    problems = FrameProblems(
        muscles,
        result.coordinates,
        SHARING,
        result.moment[comparison.frames],
        arms,
        np.broadcast_to(strength, shape),
        np.zeros(shape),
    )
    activation = np.array([problems.solved(k)[0] for k in range(len(comparison.frames))])
    assert comparison.rms(activation) < 0.002
