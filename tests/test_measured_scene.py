"""One frame of JW's og3 from its scene: muscles, EMG and measured force in the results."""

from pathlib import Path

import numpy as np
import pytest

from jw_gait import needs_jw
from tkamb.run.columns import CONTRIBUTIONS, belongs
from tkamb.run.simulation import simulate

SCENE = Path(__file__).parents[1] / "models" / "jw" / "ngait_og3_measured.toml"
LATE_STANCE = 15


@pytest.mark.slow
@needs_jw
def test_the_results_have_muscle_groups_contributions_measured_force_and_emg():
    run = simulate(SCENE, frames=slice(LATE_STANCE, LATE_STANCE + 1))
    groups = run.summary["muscle_groups"]
    assert set(groups["knee extensors"]) == {"recfem", "vasint", "vaslat", "vasmed"}
    assert set(groups["thigh to foot"]) == {"gaslat", "gasmed"}
    for side, family in CONTRIBUTIONS.items():
        parts = [run[name] for name in run.columns if belongs(name, family)]
        np.testing.assert_allclose(sum(parts), run[f"{side}_force_equilibrium_N"], atol=1e-6)
    assert run.summary["measured"]["total"]["frames_compared"] == 1
    emg = run.summary["emg"]["muscles"]
    assert {f"envelope_{name}" for name in emg} <= set(run.columns)
    assert all(one["frames_compared"] == 1 for one in emg.values())
