"""Output for readers: report, comparison, check of a scene, viewer.

`tkamb.show(results)` was a function before release 0.2. It is now `tkamb.view(results)`; the old
call works until 0.3.
"""

import sys
import warnings
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    """This package, which can still be called like the former function of its name."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Return what `tkamb.view` returns, with a warning."""
        from tkamb.show.view.show import show

        warnings.warn("tkamb.show is now tkamb.view", DeprecationWarning, stacklevel=2)
        return show(*arguments, **options)


sys.modules[__name__].__class__ = _CallableModule
