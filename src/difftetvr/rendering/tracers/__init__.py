"""Which cells does a ray cross, in which order?

Three answers, the article's two and the walk: `marching`, `linked_list`, `projected`, and what they are built from.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
