#!/usr/bin/env python3
"""Compare the lattice with CalculiX on the same hexahedra of a two-condyle insert.

CalculiX (Debian package calculix-ccx) solves it with C3D8 or C3D8I elements and node-to-surface
penalty contact of 1e5 N/mm³ against the rigid femoral triangles; the femoral component moves
along y only, pushed by the load at a reference node. CalculiX's C3D8 is fully integrated (its
stiffness equals the plain 2×2×2 one to seven digits) and locks at nu = 0.45; C3D8I does not.
Its Ramberg-Osgood (*DEFORMATION PLASTICITY) needs NLGEOM, so the nonlinear comparison is one of
small strain (tkamb) with finite strain (CalculiX).

    scripts/peer_calculix.py --resolution 1 --load 2500 --out FOLDER
"""

import argparse
import json
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from lattice_cases import two_condyles
from tkamb.contact.materials import material
from tkamb.contact.model import ContactPair
from tkamb.contact.pressing import pose_at_approach
from tkamb.contact.registry import contact_model
from tkamb.geometry.surface import Surface

PENALTY = 1e5
UPWARDS = np.array([0, 1e-3, 0])
REACH = 2.5e-3
"""m: femoral triangles within this height of the lowest point take part."""


def femoral_patch(femoral, pose):
    """Return the lower triangles of the femoral component in the insert frame (m)."""
    placed = femoral.moved(pose)
    low = placed.triangles[..., 1].min(axis=1) < placed.vertices[:, 1].min() + REACH
    keep = low & (placed.face_normals[:, 1] < -0.3)
    used, faces = np.unique(placed.faces[keep], return_inverse=True)
    return Surface(placed.vertices[used], faces.reshape(-1, 3), "patch")


def deck(lattice, patch, mat, load, nonlinear, depth, element):
    """Return the CalculiX input, mm, N, MPa. The femoral patch is a rigid layer of wedges.

    The first step moves it down by `depth` (m) to establish contact, the second lets it go
    under the load.
    """
    n, m = len(lattice.nodes), len(patch.vertices)
    places = np.concatenate([lattice.nodes, patch.vertices, patch.vertices + UPWARDS]) * 1e3
    reference = len(places) + 1
    lines = ["*NODE, NSET=NALL"]
    lines += [f"{i},{x:.9e},{y:.9e},{z:.9e}" for i, (x, y, z) in enumerate(places, 1)]
    lines += [f"{reference},0.,30.,0.", f"{reference + 1},0.,30.,0."]
    first = len(lattice.cells) + 1
    wedges = patch.faces[:, [0, 2, 1]] + n
    wedges = np.concatenate([wedges, wedges + m], axis=1)
    lines.append(f"*ELEMENT, TYPE={element}, ELSET=INSERT")
    lines += _numbered(1, lattice.cells)
    lines.append("*ELEMENT, TYPE=C3D6, ELSET=FEMUR")
    lines += _numbered(first, wedges)
    lines += _set("NBOTTOM", lattice.bottom_nodes) + _set("NREF", [reference - 1])
    lines += _set("NSLAVE", np.unique(lattice.contact_triangles))
    lines += _set("NFEMUR", np.arange(n, n + 2 * m)) + _set("NINSERT", np.arange(n))
    lines += ["*SURFACE, NAME=SLAVE, TYPE=NODE", "NSLAVE", "*SURFACE, NAME=MASTER"]
    lines += [f"{first + e},S1" for e in range(len(wedges))]
    e, nu, law = mat.young_modulus / 1e6, mat.poisson_ratio, mat.law
    lines.append("*MATERIAL, NAME=PE")
    if nonlinear:
        lines.append("*DEFORMATION PLASTICITY")
        lines.append(f"{e},{nu},{law.reference_stress / 1e6},{law.exponent},{law.alpha}")
    else:
        lines += ["*ELASTIC", f"{e},{nu}"]
    lines += ["*MATERIAL, NAME=STEEL", "*ELASTIC", "2.1E5,0.3"]
    lines += ["*SOLID SECTION, ELSET=INSERT, MATERIAL=PE"]
    lines += ["*SOLID SECTION, ELSET=FEMUR, MATERIAL=STEEL"]
    lines += [f"*RIGID BODY, NSET=NFEMUR, REF NODE={reference}, ROT NODE={reference + 1}"]
    lines += ["*SURFACE INTERACTION, NAME=SI", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR"]
    lines += [f"{PENALTY},0.001"]
    lines += ["*CONTACT PAIR, INTERACTION=SI, TYPE=NODE TO SURFACE", "SLAVE,MASTER"]
    held = ["NBOTTOM,1,3", f"{reference},1,1", f"{reference},3,3", f"{reference + 1},1,3"]
    step = "*STEP, INC=300" + (", NLGEOM" if nonlinear else "")
    lines += ["*BOUNDARY", *held, step, "*STATIC", "0.1,1.,1e-7,0.25"]
    lines += ["*BOUNDARY", f"{reference},2,2,{-1e3 * depth}", "*END STEP"]
    lines += [step, "*STATIC", "0.5,1.,1e-7,1.", "*BOUNDARY, OP=NEW", *held]
    lines += ["*CLOAD", f"{reference},2,{-load}"]
    lines += ["*NODE PRINT, NSET=NREF, FREQUENCY=1000", "U"]
    lines += ["*NODE PRINT, NSET=NINSERT, FREQUENCY=1000", "U"]
    lines += ["*NODE PRINT, NSET=NBOTTOM, FREQUENCY=1000, TOTALS=ONLY", "RF"]
    lines += ["*CONTACT PRINT, FREQUENCY=1000", "CSTR", "*END STEP", ""]
    return "\n".join(lines)


def _numbered(first, members):
    return [f"{i},{','.join(str(v + 1) for v in row)}" for i, row in enumerate(members, first)]


def _set(name, nodes):
    return [f"*NSET, NSET={name}"] + [str(v + 1) for v in nodes]


def run_calculix(text, folder):
    """Run the deck; return seconds, peak memory (MB) and the .dat file's blocks."""
    (folder / "peer.inp").write_text(text)
    begun = time.perf_counter()
    subprocess.run(["ccx", "-i", "peer"], cwd=folder, check=True, capture_output=True, text=True)
    seconds = time.perf_counter() - begun
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
    blocks, rows = {}, None
    for line in (folder / "peer.dat").read_text().splitlines():
        words = line.split()
        if not words:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            rows = blocks.setdefault(" ".join(words).split(" for set ")[0] + _which(words), [])
            rows.clear()
            continue
        rows.append(values)
    return seconds, memory, {key: np.array(rows) for key, rows in blocks.items() if rows}


def _which(words):
    return f" {words[words.index('set') + 1]}" if "set" in words else ""


def peer_row(blocks, state, area):
    """Return approach, condyle forces, peak and area from CalculiX's output."""
    surface, top = state.map, state.problem.contact_nodes
    stress = next(v for k, v in blocks.items() if k.startswith("contact stress"))
    place = np.searchsorted(top, stress[:, 0].astype(int) - 1)
    pressure = np.zeros(len(top))
    pressure[place] = np.maximum(stress[:, 1], 0.0) * 1e6
    vertical = pressure * area * surface.normals[:, 1]
    medial = surface.points[:, 2] < 0
    return {
        "approach_mm": -float(blocks["displacements (vx,vy,vz) NREF"][-1, 2]),
        "medial_N": float(vertical[medial].sum()),
        "lateral_N": float(vertical[~medial].sum()),
        "peak_MPa": float(pressure.max()) / 1e6,
        "area_mm2": float(area[pressure > 0.1e6].sum()) * 1e6,
        "reaction_N": float(blocks["total force (fx,fy,fz) NBOTTOM"][-1, 1]),
    }


def own_row(result):
    """Return the same of a tkamb result; forces along y."""
    vertical = -result.nodal_force[:, 1]
    medial = result.points[:, 2] < 0
    return {
        "approach_mm": result.approach * 1e3,
        "medial_N": float(vertical[medial].sum()),
        "lateral_N": float(vertical[~medial].sum()),
        "peak_MPa": float(result.pressure.max()) / 1e6,
        "area_mm2": float(result.area[result.pressure > 0.1e6].sum()) * 1e6,
        "reaction_N": float(vertical.sum()),
    }


def compare(options, nonlinear):
    """Return rows of all models on one grid."""
    femoral, insert, pose = two_condyles(options.varus)
    mat = material("polyethylene" if nonlinear else "polyethylene-linear")
    pair, rows = ContactPair(femoral, insert, mat), []
    for name in ("lattice", "fe"):
        model = contact_model(name, options.resolution, cache=False)
        begun = time.perf_counter()
        state = model.prepare(pair)
        middle = time.perf_counter()
        result = model.press(state, options.load, pose)
        seconds = time.perf_counter() - middle
        rows.append({"model": name, "prepare_s": middle - begun, "solve_s": seconds,
                     "rss_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
                     **own_row(result)})  # fmt: skip
    patch = femoral_patch(femoral, pose_at_approach(pair, pose, 0.0))
    for element in options.elements:
        with tempfile.TemporaryDirectory() as folder:
            text = deck(
                state.lattice, patch, mat, options.load, nonlinear, 0.8 * result.approach, element
            )
            seconds, memory, blocks = run_calculix(text, Path(folder))
        rows.append({"model": f"CalculiX {element}", "prepare_s": 0.0, "solve_s": seconds,
                     "rss_MB": memory, **peer_row(blocks, state, state.map.area)})  # fmt: skip
    for row in rows:
        row.update(nonlinear=nonlinear, resolution_mm=options.resolution, varus_deg=options.varus)
        row.update(load_N=options.load, nodes=len(state.lattice.nodes))
    return rows


def picture(rows, path):
    """Draw approach and peak pressure of every model beside each other."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for axis, key, title in zip(
        axes, ("approach_mm", "peak_MPa"), ("approach, mm", "peak pressure, MPa"), strict=True
    ):
        for shift, nonlinear in enumerate((False, True)):
            some = [row for row in rows if row["nonlinear"] is nonlinear]
            place = np.arange(len(some)) + 0.4 * shift - 0.2
            axis.bar(place, [row[key] for row in some], 0.38,
                     label="nonlinear" if nonlinear else "linear")  # fmt: skip
            axis.set_xticks(range(len(some)), [row["model"] for row in some], fontsize=8)
        axis.set_title(title, fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=150)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--resolution", type=float, default=2.0, help="mm")
    parser.add_argument("--load", type=float, default=2500.0, help="N")
    parser.add_argument("--varus", type=float, default=0.0, help="degrees")
    parser.add_argument("--elements", nargs="+", default=["C3D8", "C3D8I"])
    parser.add_argument("--laws", nargs="+", default=["linear", "nonlinear"])
    parser.add_argument("--out", type=Path, default=Path("peer_calculix"))
    options = parser.parse_args()
    if shutil.which("ccx") is None:
        raise SystemExit("CalculiX is not installed: apt-get install calculix-ccx")
    rows = []
    for law in options.laws:
        rows += compare(options, law == "nonlinear")
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "peer_calculix.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    keys = ["model", "nonlinear", "approach_mm", "medial_N", "lateral_N", "peak_MPa", "area_mm2",
            "reaction_N", "prepare_s", "solve_s", "rss_MB"]  # fmt: skip
    print(" | ".join(keys))
    for row in rows:
        words = (
            row[key] if isinstance(row[key], str | bool) else f"{row[key]:.4g}" for key in keys
        )
        print(" | ".join(str(word) for word in words))
    picture(rows, options.out / "peer_calculix.png")


if __name__ == "__main__":
    main()
