from . import absorption as absorption
from . import kernel as kernel
from . import light as light

__all__: list[str] = []
