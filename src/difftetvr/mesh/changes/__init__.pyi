from . import bisection as bisection
from . import change as change
from . import collapse as collapse
from . import flip_search as flip_search
from . import flips as flips
from . import independent as independent
from . import insertion as insertion
from . import removal as removal
from . import star as star

__all__: list[str] = []
