"""Output for readers: report, comparison, check of a scene, viewer.

`tkamb.show(results)` was a function before release 0.2. It is now `tkamb.view(results)`; the old
call works until 0.3.
"""

import sys
import warnings
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    """This package as a function, for the old call `tkamb.show(results)`."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Return the result of `tkamb.view`, with a warning."""
        from tkamb.show.view.show import show

        warnings.warn("tkamb.show is now tkamb.view", DeprecationWarning, stacklevel=2)
        return show(*arguments, **options)


sys.modules[__name__].__class__ = _CallableModule
