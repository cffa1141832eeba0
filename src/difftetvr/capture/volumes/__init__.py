"""How does a scanned volume look through a transfer function, from cameras around it?

Volumes with their place in space, and the fine ray marching that renders their true views.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
