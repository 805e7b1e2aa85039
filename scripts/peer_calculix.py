#!/usr/bin/env python3
"""Compare the lattice and `fe` with CalculiX on the same hexahedra of a two-condyle insert.

    scripts/peer_calculix.py --out out/peer_calculix --resume
    scripts/peer_calculix.py --page

The first command presses every case with every model, each in a separate process, and writes
peer_calculix.json, .md and .png. With --resume it skips the rows that are finished. With --page it
also copies the JSON to scripts/data/ and makes docs/development/peer_calculix.md and its picture
from it. The second command makes them from scripts/data/peer_calculix.json and measures nothing.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from lattice_cases import two_condyles  # noqa: E402
from tkamb.contact.materials import material  # noqa: E402
from tkamb.contact.pair import ContactPair  # noqa: E402
from tkamb.contact.registry import contact_model  # noqa: E402
from tkamb.files import claim_directory, write_text  # noqa: E402
from tkamb.geometry.memory import peak_rss  # noqa: E402
from tkamb.studies.calculix import find_program, press_by_calculix  # noqa: E402
from tkamb.studies.cases import StudyCase  # noqa: E402
from tkamb.studies.kept_rows import KeptRows, row_key  # noqa: E402
from tkamb.studies.measures import ONE_THREAD  # noqa: E402
from tradeoff_blocks import with_block  # noqa: E402

PEER = "CalculiX C3D8I"
MODELS = ("lattice", "fe", PEER, "CalculiX C3D8")
LAWS = ("linear", "nonlinear")
LOADS_N = (1000.0, 2500.0)
VARUS_DEG = (0.0, 0.3)
LEAST_PRESSURE = 0.1e6
"""Pa: smallest pressure of a node that counts towards the area."""
WARM_PRESSES = 5
LIMITS = {
    ("lattice", "linear"): {"approach": 2.0, "force": 2.0, "peak": 4.0, "area": 5.0},
    ("fe", "linear"): {"approach": 1.5, "peak": 2.0},
    ("lattice", "nonlinear"): {"approach": 5.0},
}
"""Largest specified difference from `PEER`, per cent."""
DOCS, DATA = ROOT / "docs", ROOT / "scripts" / "data"


def study_case(job):
    """Return a case of two condyles over two dishes."""
    femoral, insert, pose = two_condyles(job["varus_deg"])
    mat = material("polyethylene" if job["law"] == "nonlinear" else "polyethylene-linear")
    return StudyCase("two condyles", "", ContactPair(femoral, insert, mat), pose, job["load_N"])


def measure(job):
    """Press one case with one model; return its row."""
    case = study_case(job)
    if job["model"].startswith("CalculiX"):
        element = job["model"].split()[1]
        answer = press_by_calculix(case.pair, case.load, case.pose, job["resolution_mm"], element)
        took = (answer.prepare_seconds, answer.run.seconds, answer.run.seconds)
        return took_row(job, answer.nodes, *took, answer.run.peak_rss_MB) | found(answer.result)
    model = contact_model(job["model"], resolution=job["resolution_mm"] * 1e-3, cache=False)
    prepare, state = timed(model.prepare, case.pair)
    cold, (result, start) = timed(model.press_from, state, case.load, case.pose)
    warm = []
    for step in range(1, WARM_PRESSES + 1):
        seconds, (_, start) = timed(model.press_from, state, case.load, case.nearby(step), start)
        warm.append(seconds)
    took = (prepare, cold, median(warm))
    return took_row(job, state.node_count, *took, peak_rss()) | found(result)


def timed(call, *given):
    start = time.perf_counter()
    answer = call(*given)
    return time.perf_counter() - start, answer


def took_row(job, nodes, prepare, cold, warm, memory):
    return job | {"nodes": nodes, "prepare_s": prepare, "cold_s": cold, "warm_s": warm,
                  "peak_rss_MB": memory}  # fmt: skip


def found(result):
    """Return the quantities to compare, with the same definition for every model.

    The effective area is (sum F)²/sum(F p). A uniform pressure on this area has the same force and
    the same sum(F p). Nodes with a very small pressure hardly change it.
    """
    size = np.linalg.norm(result.nodal_force, axis=1)
    return {
        "approach_mm": result.approach * 1e3,
        "medial_N": result.medial.force,
        "lateral_N": result.lateral.force,
        "peak_MPa": float(result.pressure.max()) / 1e6,
        "area_mm2": float(result.area[result.pressure > LEAST_PRESSURE].sum()) * 1e6,
        "effective_area_mm2": float(size.sum() ** 2 / (size @ result.pressure)) * 1e6,
        "carried": -float(result.wrench_on_insert[1]),
        "iterations": result.iterations,
    }


def same_case(row):
    return row["law"], row["load_N"], row["varus_deg"]


def differences(row, peer):
    """Return the differences of a row from the peer's, per cent; the larger of both condyles."""
    forces = [row[side] / peer[side] - 1 for side in ("medial_N", "lateral_N")]
    apart = {
        "approach": row["approach_mm"] / peer["approach_mm"] - 1,
        "force": max(forces, key=abs),
        "peak": row["peak_MPa"] / peer["peak_MPa"] - 1,
        "area": row["area_mm2"] / peer["area_mm2"] - 1,
        "effective": row["effective_area_mm2"] / peer["effective_area_mm2"] - 1,
    }
    return {key: 100 * value for key, value in apart.items()}


def block(rows):
    """Return the page's tables: every case, the specified differences, time and memory."""
    peers = {same_case(row): row for row in rows if row["model"] == PEER}
    lines = [
        "| law | N | varus ° | model | approach mm | off % | medial / lateral N | off % "
        "| peak MPa | off % | area mm² | off % | effective area off % | carried N |",
        "| --- | ---: | ---: | --- |" + " ---: |" * 10,
    ]
    for row in rows:
        off = differences(row, peers[same_case(row)])
        shown = dict.fromkeys(off, "") if row["model"] == PEER else {
            key: f"{round(value, 1) + 0.0:+.1f}" for key, value in off.items()
        }  # fmt: skip
        lines.append(
            f"| {row['law']} | {row['load_N']:.0f} | {row['varus_deg']:g} | {row['model']} "
            f"| {row['approach_mm']:.4f} | {shown['approach']} "
            f"| {row['medial_N']:.0f} / {row['lateral_N']:.0f} | {shown['force']} "
            f"| {row['peak_MPa']:.2f} | {shown['peak']} | {row['area_mm2']:.1f} | {shown['area']} "
            f"| {shown['effective']} | {row['carried']:.1f} |"
        )
    return [*lines, "", *asked_for(rows, peers), "", *costs(rows)]


def asked_for(rows, peers):
    lines = ["| | limit % | largest % | |", "| --- | ---: | ---: | --- |"]
    for (model, law), limits in LIMITS.items():
        some = [row for row in rows if (row["model"], row["law"]) == (model, law)]
        for key, limit in limits.items() if some else ():
            worst = max(abs(differences(row, peers[same_case(row)])[key]) for row in some)
            verdict = "holds" if worst <= limit else "does not hold"
            lines.append(f"| `{model}`, {law}: {key} | {limit:g} | {worst:.2f} | {verdict} |")
    return lines


def costs(rows):
    """Return time and memory of each model, medians over the cases."""
    lines = [
        "| model | law | prepare s | first press s | next press s | MB | iterations |",
        "| --- | --- |" + " ---: |" * 5,
    ]
    for model in MODELS:
        for law in LAWS:
            some = [row for row in rows if (row["model"], row["law"]) == (model, law)]
            if some:
                keys = ("prepare_s", "cold_s", "warm_s", "peak_rss_MB", "iterations")
                middle = " | ".join(f"{median(row[key] for row in some):.3g}" for key in keys)
                lines.append(f"| {model} | {law} | {middle} |")
    return lines


def picture(rows):
    """Return the figure: the difference of every model from the peer in each case."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    peers = {same_case(row): row for row in rows if row["model"] == PEER}
    places = {case: place for place, case in enumerate(reversed(list(peers)))}
    figure, axes = plt.subplots(1, 4, figsize=(11, 3.4), sharey=True, layout="constrained")
    titles = {"approach": "approach", "force": "condyle force",
              "peak": "peak pressure", "area": "area"}  # fmt: skip
    looks = {"lattice": ("o", "#d1495b"), "fe": ("s", "#30638e"), "CalculiX C3D8": ("x", "#888888")}
    for axis, (key, title) in zip(axes, titles.items(), strict=True):
        for law in LAWS:
            limit = LIMITS["lattice", law].get(key)
            rung = [place for case, place in places.items() if case[0] == law]
            if limit and rung:
                axis.fill_betweenx([min(rung) - 0.5, max(rung) + 0.5], -limit, limit,
                                   color="#d1495b", alpha=0.12, lw=0)  # fmt: skip
        for model, (marker, colour) in looks.items():
            some = [row for row in rows if row["model"] == model]
            off = [differences(row, peers[same_case(row)])[key] for row in some]
            at = [places[same_case(row)] for row in some]
            axis.scatter(off, at, 30, marker=marker, color=colour, label=model, zorder=3)
        axis.axvline(0, color="k", lw=0.8)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel(f"% off {PEER}", fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
    names = [f"{law}, {load:.0f} N, {varus:g}°" for law, load, varus in places]
    axes[0].set_yticks(list(places.values()), names, fontsize=8)
    axes[0].set_ylim(-0.6, len(places) - 0.4)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3,
                  frameon=False, fontsize=9)  # fmt: skip
    return figure


def measured_rows(options):
    """Return the rows of all jobs, finished rows first."""
    find_program()
    kept = KeptRows(claim_directory(options.out), options.resume)
    rows = []
    for law in options.laws:
        for load in options.loads:
            for varus in options.varus:
                for model in MODELS:
                    job = {"model": model, "law": law, "load_N": load, "varus_deg": varus,
                           "resolution_mm": options.resolution}  # fmt: skip
                    key = row_key("peer_calculix", job)
                    row = kept.get(key) or apart(job)
                    kept.put(key, row)
                    rows.append(row)
                    print(json.dumps(row), flush=True)
    return rows


def apart(job):
    """Measure in a separate process with one thread."""
    import os

    command = [sys.executable, __file__, "--one", json.dumps(job)]
    return json.loads(subprocess.check_output(command, text=True, env=os.environ | ONE_THREAD))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--resolution", type=float, default=1.0, metavar="MM")
    parser.add_argument("--loads", type=float, nargs="+", default=LOADS_N, metavar="N")
    parser.add_argument("--varus", type=float, nargs="+", default=VARUS_DEG, metavar="DEG")
    parser.add_argument("--laws", nargs="+", choices=LAWS, default=LAWS)
    parser.add_argument("--out", type=Path, metavar="FOLDER")
    parser.add_argument("--resume", action="store_true", help="keep finished rows")
    parser.add_argument("--page", action="store_true", help="write the page in docs/")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(json.loads(options.one))))
        return
    kept = DATA / "peer_calculix.json"
    rows = measured_rows(options) if options.out else json.loads(kept.read_text(encoding="utf-8"))
    text = json.dumps(rows, indent=1) + "\n"
    if options.out:
        write_text(options.out / "peer_calculix.json", text)
        write_text(options.out / "peer_calculix.md", "\n".join(block(rows)) + "\n")
        picture(rows).savefig(options.out / "peer_calculix.png", dpi=110)
    if options.page:
        page = DOCS / "development" / "peer_calculix.md"
        write_text(kept, text)
        write_text(page, with_block(page.read_text(encoding="utf-8"), block(rows), "peer"))
        picture(rows).savefig(DOCS / "pictures" / "peer_calculix.png", dpi=110)


if __name__ == "__main__":
    main()
