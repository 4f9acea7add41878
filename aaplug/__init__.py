"""Test-time anti-aliasing for pretrained 3D Gaussian Splatting scenes.

`__init__.pyi` beside this file lists everything that is public.  Names are imported when they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
