#!/usr/bin/env python3
"""Measure time and memory of the lattice, and the convergence of its results with the cell size.

Each row runs in its own process with one thread, so that its peak memory can be measured;
OMP_NUM_THREADS and TKAMB_THREADS change the number of threads. `approach_s` is the time that it
takes to compute the approach since first touch, which a press does only when asked.

    scripts/bench_lattice.py --cases two-condyles dm30 jw --data FOLDER --resolutions 2 1.5 1
    scripts/bench_lattice.py --cases shipped --contacts lattice --resolutions 1 0.75 0.5
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TKAMB_THREADS", "1")

import numpy as np

from lattice_cases import contact_pair, nearby
from tkamb.contact.registry import contact_model


def measure(case, data, name, resolution, load, repeats):
    """Return the row of one case, model and resolution."""
    pair, at = contact_pair(case, data, "polyethylene")
    model = contact_model(name, resolution=resolution * 1e-3, cache=False)
    begun = time.perf_counter()
    state = model.prepare(pair)
    prepare = time.perf_counter() - begun
    begun = time.perf_counter()
    result, start = model.press_from(state, load, at)
    cold = time.perf_counter() - begun
    warm, again, reading = [], [], []
    passes = []
    for k in range(1, repeats + 1):
        there = nearby(at, 0.2 * k)
        begun = time.perf_counter()
        pressed, start = model.press_from(state, load, there, start)
        warm.append(time.perf_counter() - begun)
        passes.append(pressed.iterations)
        begun = time.perf_counter()
        _ = pressed.approach
        reading.append(time.perf_counter() - begun)
        begun = time.perf_counter()
        model.press(state, load, there)
        again.append(time.perf_counter() - begun)
    sides = {
        side: None
        if condyle is None
        else {
            "force_N": round(condyle.force, 1),
            "area_mm2": round(condyle.area * 1e6, 2),
            "peak_MPa": round(condyle.peak_pressure / 1e6, 3),
        }
        for side, condyle in (("medial", result.medial), ("lateral", result.lateral))
    }
    return {
        "case": case, "contact": name, "resolution_mm": resolution, "load_N": load,
        "nodes": len(state.lattice.nodes), "contact_nodes": len(state.points),
        "factor_M": round(state.problem.operator.factor.entries / 1e6, 2),
        "prepare_s": round(prepare, 2), "cold_s": round(cold, 4),
        "warm_s": round(statistics.median(warm), 4),
        "no_guess_s": round(statistics.median(again), 4),
        "approach_s": round(statistics.median(reading), 4),
        "warm_passes": passes, "iterations": result.iterations, "status": result.status.value,
        "approach_mm": round(result.approach * 1e3, 5),
        "peak_MPa": round(float(result.pressure.max()) / 1e6, 3),
        "area_mm2": round(sum(side["area_mm2"] for side in sides.values() if side), 2), **sides,
        "rss_MB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
        "flags": result.flags,
    }  # fmt: skip


def table(rows):
    """Print the rows and, per case and model, the exponents of time and memory."""
    keys = ["case", "contact", "resolution_mm", "nodes", "prepare_s", "cold_s", "warm_s",
            "no_guess_s", "approach_s", "iterations", "approach_mm", "peak_MPa", "area_mm2",
            "rss_MB", "status"]  # fmt: skip
    print(" | ".join(keys))
    for row in rows:
        print(" | ".join(str(row[key]) for key in keys), flush=True)
    for case, name in sorted({(row["case"], row["contact"]) for row in rows}):
        some = [r for r in rows if (r["case"], r["contact"]) == (case, name)]
        if len(some) < 2:
            continue
        size = np.log([r["nodes"] for r in some])
        for key in ("prepare_s", "warm_s", "factor_M", "rss_MB"):
            slope = np.polyfit(size, np.log([r[key] for r in some]), 1)[0]
            print(f"{case} {name}: {key} ~ nodes^{slope:.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="+", default=["two-condyles"])
    parser.add_argument("--contacts", nargs="+", default=["lattice", "lattice-linear", "fe"])
    parser.add_argument("--resolutions", nargs="+", type=float, default=[3.0, 2.0, 1.5])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--load", type=float, default=2500.0)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        row = measure(
            options.cases[0], options.data, options.contacts[0], options.resolutions[0],
            options.load, options.repeats,
        )  # fmt: skip
        print(json.dumps(row))
        return
    rows = []
    for case in options.cases:
        for name in options.contacts:
            for resolution in options.resolutions:
                command = [sys.executable, __file__, "--one", "--cases", case, "--contacts", name]
                command += ["--resolutions", str(resolution), "--load", str(options.load)]
                command += ["--repeats", str(options.repeats)]
                command += ["--data", str(options.data)] if options.data else []
                ran = subprocess.run(command, capture_output=True, text=True, check=False)
                if ran.returncode:
                    print(case, name, resolution, "failed:", ran.stderr.strip().splitlines()[-1:])
                    continue
                rows.append(json.loads(ran.stdout))
    table(rows)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
