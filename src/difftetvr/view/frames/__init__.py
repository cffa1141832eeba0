"""What is put on paper of what was rendered?

Frames over a background or none, with colour bars and axes; and films of them.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
