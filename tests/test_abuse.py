"""Some abusive inputs of scripts/study/abuse and scripts/study/fuzz_http do no damage."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts" / "study"


@pytest.mark.parametrize(
    ("inputs", "seed"), [(6, 1), pytest.param(1000, 10_000, marks=pytest.mark.slow)]
)
def test_abusive_inputs_break_nothing(inputs, seed):
    command = [
        sys.executable,
        SCRIPTS / "abuse",
        "--inputs",
        str(inputs),
        "--seed",
        str(seed),
    ]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr


def test_hostile_requests_break_no_server():
    """The servers are those of `tkamb view` and `tkamb live`."""
    command = [sys.executable, SCRIPTS / "fuzz_http", "--inputs", "150"]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr
