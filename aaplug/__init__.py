"""Test-time anti-aliasing for pretrained 3D Gaussian Splatting scenes.

`__init__.pyi` beside this file lists everything that is public.  Names are imported when they are first used.
"""

from typing import Any

import lazy_loader

_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version(__name__)
    from aaplug.system.contracts import in_memory

    try:
        with in_memory():  # modules have constants
            return _imported(name)
    except AttributeError as error:
        if name in __all__:
            raise
        from aaplug.system.errors import did_you_mean

        raise AttributeError(f"{error}{did_you_mean(name, __all__)}") from None
