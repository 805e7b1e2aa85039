"""Some abusive inputs of scripts/study/abuse and scripts/study/fuzz_http do no damage."""

import logging
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts" / "study"


def script(name):
    """Return a script as a module."""
    loader = SourceFileLoader(name, str(SCRIPTS / name))
    module = module_from_spec(spec_from_loader(name, loader))
    loader.exec_module(module)
    return module


def test_some_abusive_inputs_break_nothing(tmp_path, monkeypatch):
    """One input of each kind, in this process. The script and the slow test try many, in others."""
    abuse = script("abuse")
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # the script redirects them
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr("tkamb.show.report.report_html", lambda results, progress=None: "<html/>")
    monkeypatch.setenv("TKAMB_ABUSE_RESULTS", str(abuse.make_results(tmp_path)))
    for kind in abuse.KINDS:
        row = abuse.tried(kind, 1, tmp_path)
        assert not row["broken"], row


@pytest.mark.slow
def test_abusive_inputs_break_nothing():
    command = [sys.executable, SCRIPTS / "abuse", "--inputs", "1000", "--seed", "10000"]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr


def test_hostile_requests_break_no_server(monkeypatch, tmp_path, capsys):
    """The servers are those of `tkamb view` and `tkamb live`."""
    monkeypatch.chdir(tmp_path)  # the script changes the folder
    monkeypatch.setattr(sys, "argv", ["fuzz_http", "--inputs", "150"])
    assert script("fuzz_http").main() == 0, capsys.readouterr().out
