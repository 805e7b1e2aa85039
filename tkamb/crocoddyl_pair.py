"""Whether the installed Crocoddyl fits the installed Pinocchio.

Crocoddyl is compiled against one version of Pinocchio and reads its memory: with another one its
residuals read wrong numbers, or the process ends. `checked` refuses such a pair.
"""

import subprocess
import sys

from tkamb.errors import InputError

TESTED = {("3.2.1", "4.0.0")}
"""Pairs of versions (Crocoddyl, Pinocchio) of the wheels on PyPI that pass `SELF_CHECK`."""

SELF_CHECK = """
import crocoddyl
import numpy as np
import pinocchio as pin

model, rng = pin.buildSampleModelManipulator(), np.random.default_rng(0)
state = crocoddyl.StateMultibody(model)
actuation = crocoddyl.ActuationModelFull(state)
q, v, u = rng.uniform(-1.0, 1.0, (3, model.nv))
frame, target = model.nframes - 1, np.array([0.3, 0.2, 0.1])
costs = crocoddyl.CostModelSum(state, actuation.nu)
residual = crocoddyl.ResidualModelFrameTranslation(state, frame, target, actuation.nu)
costs.addCost("frame", crocoddyl.CostModelResidual(state, residual), 1.0)
dynamics = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
data, plain = dynamics.createData(), model.createData()
dynamics.calc(data, np.concatenate([q, v]), u)
pin.framesForwardKinematics(model, plain, q)
away = plain.oMf[frame].translation - target
assert np.allclose(data.xout, pin.aba(model, plain, q, v, u)), "another acceleration"
expected = 0.5 * float(away @ away)
assert np.isclose(data.cost, expected), f"a frame's cost of {data.cost:.3g} for {expected:.3g}"
"""
"""Compares a frame's cost and an acceleration of Crocoddyl with those of Pinocchio."""


def checked(crocoddyl: str, pinocchio: str) -> None:
    """Raise an error unless a pair of versions is tested, or passes `SELF_CHECK` in a process.

    Raises:
        InputError: Crocoddyl does not fit Pinocchio; the message has both versions and a pair that
            fits.
    """
    if (crocoddyl, pinocchio) in TESTED:
        return
    # A pair that does not fit may end its process.
    child = subprocess.run([sys.executable, "-c", SELF_CHECK], capture_output=True, text=True)
    if child.returncode == 0:
        return
    why = child.stderr.strip().rpartition("\n")[2] or f"exit status {child.returncode}"
    known = " or ".join(f'"crocoddyl=={one}" "pin=={other}"' for one, other in sorted(TESTED))
    raise InputError(
        f"Crocoddyl {crocoddyl} does not fit Pinocchio {pinocchio} ({why})",
        "tkamb.crocoddyl",
        f"install a pair that fits: pip install {known}",
    )
