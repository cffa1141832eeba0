"""Where do images come from, and which cameras took them?

A :class:`~difftetvr.Capture` holds both; inner rooms make it from photographs (`photos`) and from scanned volumes
(`volumes`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
