"""The pages that show results, looked up by name: results do not import what draws them.

Each entry is "module:function"; the module is imported when its page is asked for.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any

PAGES = {
    "cohort": "tkamb.cohort.report:cohort_html",
    "headline": "tkamb.output.report:headline_html",
    "plots": "tkamb.output.plots:plot",
    "report": "tkamb.output.report:report_html",
}


def page(name: str) -> Callable[..., Any]:
    """Return the function that makes a page.

    Args:
        name: one of `PAGES`.

    Raises:
        KeyError: no such page.
    """
    module, _, function = PAGES[name].partition(":")
    made: Callable[..., Any] = getattr(import_module(module), function)
    return made
