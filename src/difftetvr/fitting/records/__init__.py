"""What does a run leave and show: checkpoint, folder, history, metrics, progress?

Everything is written whole or not at all, and a run resumes from it to the bit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
