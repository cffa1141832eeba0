"""Which transfer function made these images of a known scalar?

Values and places of its knots are what is optimised; see DiffDVR (Weiss and Westermann 2022) for the protocol.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
