from . import crossing as crossing
from . import rays as rays
from . import transfer as transfer
from . import walk as walk

__all__: list[str] = []
