"""What is in VTK's files: legacy ones, and XML ones with those that only list others?

Both are read into the same arrays, and these made cells by the same rules.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
