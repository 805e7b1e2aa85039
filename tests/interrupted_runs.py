"""Runs that are broken off, and folders that somebody else writes into."""

import tempfile
import threading
from contextlib import contextmanager, suppress

import numpy as np

from tkamb.io.claim import claimed_directory
from tkamb.run.simulation import simulate

CLOCKS = ("status", "body_seconds", "query_seconds", "contact_seconds")
EFFORT = ("iterations", "contact_trials", "coupling_iterations")
RESIDUALS = ("coupling_change_N", "coupling_change_mm")
"""What is left of an iteration that has converged; no result."""
TOLERANCES = {
    "approach_mm": 1e-3,
    "peak_pressure_MPa": 2e-3,
    "mean_pressure_MPa": 4e-3,
    "area_mm2": 4e-3,
    "area_above_yield": 4e-3,
    "per_adduction_N_per_deg": 1e-2,
}
"""End of a column's name -> how far the lattice's answer may depend on its warm start: twice what
`tests/test_lattice_residual.py` holds it to. Of the column's peak; of one for shares."""
OTHER = 1e-3
"""Of the largest contact force for forces, of the column's peak for all others."""


def broken_off(after):
    """Return a `progress` that is interrupted after so many jobs."""

    def progress(jobs, count=None):
        for index, one in enumerate(jobs):
            if index == after:
                raise KeyboardInterrupt
            yield one

    return progress


@contextmanager
def held_elsewhere(folder):
    """Have another thread write into a folder while the block runs."""
    held, done = threading.Event(), threading.Event()

    def hold():
        with claimed_directory(folder):
            held.set()
            done.wait()

    other = threading.Thread(target=hold)
    other.start()
    held.wait()
    try:
        yield
    finally:
        done.set()
        other.join()


def interrupted(scene, stops, **options):
    """Return the results of a run that is interrupted after so many more frames, each time."""
    with tempfile.TemporaryDirectory(prefix="tkamb-interrupted-") as place:
        given = {"directory": place, "resume": True, **options}
        for stop in stops:
            with suppress(KeyboardInterrupt):
                simulate(scene, progress=broken_off(stop), **given)
        return simulate(scene, **given)


def deviations(found, whole):
    """Return column -> difference of two runs of the same frames, as a share of its tolerance."""
    assert found.status == whole.status
    result = {}
    for name in whole.columns:
        if name in (*CLOCKS, *EFFORT, *RESIDUALS):
            continue
        a, b = found[name], whole[name]
        assert np.array_equal(np.isnan(a), np.isnan(b)), name
        peak = max(float(np.abs(np.nan_to_num(b)).max()), 1e-9)
        if name.endswith("_N"):
            peak = float(np.nanmax(whole["force_total_N"]))
        elif name.endswith("above_yield"):
            peak = 1.0
        tolerance = next((t for end, t in TOLERANCES.items() if name.endswith(end)), OTHER)
        result[name] = float(np.abs(np.nan_to_num(a - b)).max()) / (peak * tolerance)
    return result
