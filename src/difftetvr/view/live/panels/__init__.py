"""What can hands change of what is seen in a browser?

A panel holds the controls of one subject, which all windows share, and tells the studio what they say.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
