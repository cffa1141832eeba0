"""Options of where the viewer listens."""

from __future__ import annotations

from dataclasses import dataclass

from difftetvr.errors import DiffTetError

VIEWER_GROUP = ("host", "port")
"""Names of the options below."""


@dataclass(frozen=True)
class ServerOptions:
    """Where the viewer listens."""

    host: str = "127.0.0.1"
    """Address that the viewer listens at; 0.0.0.0: all of this machine, so that anyone in its network can look, change
    what is seen, and save files."""
    port: int | None = None
    """Port that the viewer listens at; default: 8080, or the next one that is free."""

    def require_valid(self) -> None:
        """Refuse what can be refused before anything is read.

        Raises:
            DiffTetError: The port is none.
        """
        if self.port is not None and not 0 <= self.port <= 65535:
            raise DiffTetError(f"--port is {self.port}; it must lie between 0 and 65535.")
