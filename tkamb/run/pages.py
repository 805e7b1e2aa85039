"""The pages that show results, looked up by name: results do not import what draws them.

Each entry is "module:function"; the module is imported when its page is asked for.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any

PAGES = {
    "cohort": "tkamb.show.cohort_report:cohort_html",
    "headline": "tkamb.show.report:headline_html",
    "plots": "tkamb.show.plots:plot",
    "report": "tkamb.show.report:report_html",
}


def page(name: str) -> Callable[..., Any]:
    """Return the function that makes a page.

    Args:
        name: one of `PAGES`.

    Raises:
        KeyError: no such page.
    """
    module, _, function = PAGES[name].partition(":")
    function_of_module: Callable[..., Any] = getattr(import_module(module), function)
    return function_of_module
