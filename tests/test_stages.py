"""Stages of a run: printed on a terminal, not in a pipe."""

import io
import re

from tkamb.run.timing import Stages


class Terminal(io.StringIO):
    def isatty(self):
        return True


def run_through(stream):
    """Return the output of three stages, the second with four frames, the third with two plots."""
    with Stages(3, stream) as stages:
        stages.begin("reading")
        assert list(stages.frames(range(4))) == [0, 1, 2, 3]
        assert list(stages.plots("ab")) == ["a", "b"]
    return stream.getvalue()


def test_a_terminal_shows_each_stage_with_its_time_or_a_progress_bar():
    output = run_through(Terminal())
    assert re.search(r"1/3 reading … \d+\.\d s\n", output)
    assert re.search(r"2/3 computing frames: 100%.*4/4 \[\d\d:\d\d<\d\d:\d\d", output)
    assert re.search(r"3/3 writing results and report: 100%.*2/2 \[\d\d:\d\d<", output)


def test_a_pipe_gets_no_output():
    assert run_through(io.StringIO()) == ""
