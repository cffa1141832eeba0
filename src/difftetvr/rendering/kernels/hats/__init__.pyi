from . import absorption as absorption
from . import kernel as kernel
from . import light as light
from . import scalars as scalars

__all__: list[str] = []
