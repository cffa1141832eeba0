"""The version, said once: the build, the citation and the command line take it from here."""

__version__ = "0.1.0"
