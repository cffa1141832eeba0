"""What does a run leave and show: checkpoint, folder, history, metrics, progress?

Everything is written whole or not at all, and a run resumes from it to the bit.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
