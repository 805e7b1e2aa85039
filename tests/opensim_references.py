"""Results of OpenSim, stored in tests/data.

If TKAMB_OPENSIM_PYTHON names a Python with `opensim`, the results are computed instead.
"""

import json
import os
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
WEIGHTS = np.sin(1.0 + np.arange(12.0)).reshape(3, 4)
"""Weights of the (3, 4) entries of a pose, as in scripts/make/opensim_references."""


@cache
def references() -> dict:
    """Return model name -> results of OpenSim."""
    python = os.environ.get("TKAMB_OPENSIM_PYTHON")
    if python is None:
        return json.loads((ROOT / "tests" / "data" / "opensim_references.json").read_text())
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "references.json"
        script = ROOT / "scripts" / "make" / "opensim_references"
        subprocess.run([python, str(script), str(out), "--sets", "50"], check=True)
        return json.loads(out.read_text())
