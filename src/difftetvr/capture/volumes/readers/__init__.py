"""What does each format of volume files look like?

A file a format; whatever is announced is compared with the file's size before memory is taken.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
