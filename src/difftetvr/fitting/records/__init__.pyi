from . import checkpoint as checkpoint
from . import evaluation as evaluation
from . import folder as folder
from . import history as history
from . import progress as progress
from . import result as result

__all__: list[str] = []
