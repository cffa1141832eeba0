"""Where do images come from, and which cameras took them?

A :class:`~difftetvr.Capture` holds both; inner rooms make it from photographs (`photos`) and from scanned volumes
(`volumes`). What tomographs measure is a capture of its own (`projections`).
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
