"""What do descriptions of scanners mean, ours and those of other programs? From entries in JSON to vectors of views."""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
