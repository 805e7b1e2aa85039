"""`census_recordings`: files that are read, partly read or refused, and differences."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import trimesh

from pendulum_leg import pendulum_osim
from recordings import standing_markers, write_c3d

SCRIPT = Path(__file__).parents[1] / "scripts" / "study" / "census_recordings"


def test_a_census_classifies_files(tmp_path):
    folder = tmp_path / "files"
    (folder / "deeper").mkdir(parents=True)
    time = np.arange(200) / 1000.0
    signals = {f"c{k}": np.sin(k + time) for k in range(6)}
    units = ["N"] * 3 + ["Nmm"] * 3
    good = {"analog": signals, "units": units, "plates": [{"type": 2, "channels": range(1, 7)}]}
    path = write_c3d(folder / "good.c3d", standing_markers(), **good)
    good["plates"] = [{"type": 7, "channels": range(1, 7)}]
    write_c3d(folder / "deeper" / "plate.c3d", standing_markers(), **good)
    (folder / "cut.c3d").write_bytes(path.read_bytes()[:-4000])
    (folder / "a.csv").write_text("time,x\n0,1\n", encoding="utf-8")
    (folder / "read.me").write_text("not a recording", encoding="utf-8")
    pendulum_osim(folder / "leg.osim")
    trimesh.creation.box().export(folder / "box.stl")
    trimesh.Trimesh(np.eye(3), [[0, 1, 2]]).export(folder / "open.stl")
    command = [sys.executable, str(SCRIPT), str(folder), "--json", str(tmp_path / "rows.json")]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = {row["file"]: row for row in json.loads((tmp_path / "rows.json").read_text())}
    results = {name: row["result"] for name, row in rows.items()}
    assert results == {
        "a.csv": "read",
        "box.stl": "read",
        "cut.c3d": "refused",
        "deeper/plate.c3d": "part",
        "good.c3d": "read",
        "leg.osim": "read",
        "open.stl": "part",
    }
    assert "type 7" in rows["deeper/plate.c3d"]["why"][0]
    compared = {name: row["compared"] for name, row in rows.items()}
    assert compared == {
        "a.csv": [],  # there is no second reader of text tables
        "box.stl": ["extents", "volume"],
        "cut.c3d": [],
        "deeper/plate.c3d": ["time", "markers"],
        "good.c3d": ["time", "markers", "plate 1"],
        "leg.osim": rows["leg.osim"]["compared"],  # not empty only if OpenSim is installed
        "open.stl": ["extents"],
    }
    assert f"compared with a second reader: {sum(map(bool, compared.values()))}" in output
    assert "2 part, 4 read, 1 refused" in output and "cut short" in output


def test_a_census_finds_differences_from_a_second_reader(tmp_path):
    from importlib.machinery import SourceFileLoader
    from importlib.util import module_from_spec, spec_from_loader

    loader = SourceFileLoader("census_recordings", str(SCRIPT))
    census = module_from_spec(spec_from_loader("census_recordings", loader))
    loader.exec_module(census)
    path = write_c3d(tmp_path / "a.c3d", standing_markers())
    mine = census.c3d_values(census.read_c3d(path))
    assert census.differing(path, mine, census.other_c3d) == (["time", "markers"], [])
    mine["markers"] = mine["markers"] * 1.001
    _, (line,) = census.differing(path, mine, census.other_c3d)
    assert "markers: up to" in line
