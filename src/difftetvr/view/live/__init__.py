"""How is something looked at that runs here, from a browser?

A *scene* is what there is to see, *settings* are how it is seen, a *quantity* is what is measured of each pixel. The
*studio* draws for all windows, on the one thread that works for it; the *server* carries cameras and pictures between
it and the browsers, and *panels* hold what hands can change. All but the last two knows nothing of browsers.
"""

from difftetvr._lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
