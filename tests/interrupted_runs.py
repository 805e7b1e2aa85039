"""Interrupted runs, and folders that another process claims."""

import tempfile
import threading
from contextlib import contextmanager, suppress

import numpy as np

from tkamb.io.claim import claimed_directory
from tkamb.run.simulation import simulate

CLOCKS = ("status", "body_seconds", "query_seconds", "contact_seconds")
EFFORT = ("iterations", "contact_trials", "coupling_iterations")
RESIDUALS = ("coupling_change_N", "coupling_change_mm")
"""Columns with residuals of a converged iteration, which are no results."""
TOLERANCES = {
    "approach_mm": 1e-3,
    "peak_pressure_MPa": 2e-3,
    "mean_pressure_MPa": 4e-3,
    "area_mm2": 4e-3,
    "area_above_yield": 4e-3,
    "per_adduction_N_per_deg": 1e-2,
}
"""Suffix of a column -> largest effect of the lattice's warm start, as a share of the column's peak
(of 1 for shares). It is twice the tolerance in `tests/test_lattice_residual.py`."""
OTHER = 1e-3
"""The same for other columns, as a share of the largest contact force or of the column's peak."""


def broken_off(after):
    """Return a `progress` function that raises KeyboardInterrupt after a number of jobs."""

    def progress(jobs, count=None):
        for index, job in enumerate(jobs):
            if index == after:
                raise KeyboardInterrupt
            yield job

    return progress


@contextmanager
def held_elsewhere(folder):
    """Claim a folder in another thread during the block."""
    claimed, end = threading.Event(), threading.Event()

    def hold():
        with claimed_directory(folder):
            claimed.set()
            end.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    claimed.wait()
    try:
        yield
    finally:
        end.set()
        thread.join()


def interrupted(scene, stops, **options):
    """Return the results of a run that is interrupted and resumed for each number of frames."""
    with tempfile.TemporaryDirectory(prefix="tkamb-interrupted-") as folder:
        arguments = {"directory": folder, "resume": True, **options}
        for stop in stops:
            with suppress(KeyboardInterrupt):
                simulate(scene, progress=broken_off(stop), **arguments)
        return simulate(scene, **arguments)


def deviations(results, reference):
    """Return column -> difference of two runs over its tolerance."""
    assert results.status == reference.status
    result = {}
    for name in reference.columns:
        if name in (*CLOCKS, *EFFORT, *RESIDUALS):
            continue
        a, b = results[name], reference[name]
        assert np.array_equal(np.isnan(a), np.isnan(b)), name
        peak = max(float(np.abs(np.nan_to_num(b)).max()), 1e-9)
        if name.endswith("_N"):
            peak = float(np.nanmax(reference["force_total_N"]))
        elif name.endswith("above_yield"):
            peak = 1.0
        tolerance = next((t for end, t in TOLERANCES.items() if name.endswith(end)), OTHER)
        result[name] = float(np.abs(np.nan_to_num(a - b)).max()) / (peak * tolerance)
    return result
