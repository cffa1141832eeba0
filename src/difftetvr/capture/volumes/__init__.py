"""How does a scanned volume look through a transfer function, from cameras around it?

Volumes with their place in space, and the fine ray marching that renders their true views.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
