"""What was recorded beside a run and enters none of its equations: measured force, EMG.

Nothing of this is imported unless the scene has [measured] or [muscles.emg].
"""

from collections.abc import Mapping
from typing import Any

from tkamb.columns import ENVELOPE, family_column
from tkamb.run.emg import compare_emg, fitted_normalisation
from tkamb.run.measured import compare_measured, measured_column
from tkamb.scene.case import Case


def recorded_row(case: Case, k: int) -> dict[str, float]:
    """Return column -> what was recorded at frame k."""
    row: dict[str, float] = {}
    time = case.motion.time[k : k + 1]
    if case.measured is not None:
        forces = case.measured.at(time)
        row |= {measured_column(name): float(force[0]) for name, force in forces.items()}
    if case.emg is not None:
        for name in case.emg.channel_of:
            row[family_column(ENVELOPE, name)] = float(case.emg.at(name, time)[0])
    return row


def compare_recorded(case: Case, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Return the summary's keys `measured` and `emg`, as far as the scene has them."""
    found: dict[str, Any] = {}
    if case.measured is not None:
        found["measured"] = compare_measured(columns, case.measured.force, case.body_weight)
    if case.emg is not None:
        assert case.scene.muscles is not None and case.scene.muscles.emg is not None
        table = case.scene.muscles.emg
        found["emg"] = {
            "settings": table.model_dump(mode="json", exclude_none=True),
            "muscles": compare_emg(case.emg, columns),
        }
        if table.use == "report":
            found["emg"]["fitted_normalised_by"] = fitted_normalisation(case.emg, columns)
    return found
