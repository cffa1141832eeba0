from . import checkpoint as checkpoint
from . import evaluation as evaluation
from . import folder as folder
from . import history as history
from . import perceptual as perceptual
from . import progress as progress
from . import result as result
from . import tensorboard as tensorboard

__all__: list[str] = []
