"""How is a volume sent to someone who has a browser and nothing else?

One file of HTML holds the quantised mesh with what it emits and absorbs, and the script that renders it there. The
script, ``page.js``, is built from the sources in ``web/`` of the project.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
