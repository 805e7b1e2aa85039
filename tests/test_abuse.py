"""A few of the abusive inputs of scripts/study_abuse: nothing but a line, and nothing written."""

import subprocess
import sys
from pathlib import Path

import pytest

STUDY = Path(__file__).parents[1] / "scripts" / "study_abuse"


@pytest.mark.parametrize(
    ("inputs", "seed"), [(15, 1), pytest.param(1000, 10_000, marks=pytest.mark.slow)]
)
def test_abusive_inputs_break_nothing(inputs, seed):
    command = [sys.executable, STUDY, "--inputs", str(inputs), "--seed", str(seed)]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
