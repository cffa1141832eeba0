from . import desk as desk
from . import function as function
from . import path as path
from . import run as run
from . import save as save
from . import show as show
from . import views as views

__all__: list[str] = []
