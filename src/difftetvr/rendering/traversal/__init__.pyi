from . import bundle as bundle
from . import crossing as crossing
from . import rays as rays
from . import records as records
from . import transfer as transfer
from . import walk as walk

__all__: list[str] = []
