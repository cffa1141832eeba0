from . import tomography as tomography

__all__: list[str] = []
