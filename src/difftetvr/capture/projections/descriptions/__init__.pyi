from . import astra as astra
from . import circular as circular
from . import described as described
from . import entries as entries
from . import tigre as tigre

__all__: list[str] = []
