"""The directive ``command-help``: what every command says of itself when the manual is built, so never stale."""

import os
import subprocess
import sys
from collections.abc import Iterator

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_COLUMNS = "88"


def commands() -> list[str]:
    """Names of the program's commands, in its order."""
    from difftetvr.cli import COMMANDS

    return list(COMMANDS)


def help_of(command: str) -> str:
    """What ``difftetvr COMMAND --help`` prints."""
    code = "import sys; from difftetvr.cli import main; sys.exit(main(sys.argv[1:]))"
    environment = {**os.environ, "COLUMNS": _COLUMNS, "NO_COLOR": "1", "PYTHONIOENCODING": "utf-8"}
    line = [sys.executable, "-c", code, command, "--help"]
    done = subprocess.run(line, env=environment, capture_output=True, encoding="utf-8", check=True)
    return "\n".join(part.rstrip() for part in done.stdout.strip().splitlines())


class CommandHelp(SphinxDirective):
    """A section for each command."""

    def run(self) -> list[nodes.Node]:
        """The sections."""
        # The program may have changed where the page has not: it is read anew every time.
        self.env.note_reread()
        return list(self._sections())

    def _sections(self) -> Iterator[nodes.Node]:
        for command in commands():
            section = nodes.section(ids=[f"difftetvr-{command}"], names=[f"difftetvr {command}"])
            section += nodes.title("", "", nodes.literal("", f"difftetvr {command}"))
            section += nodes.literal_block("", help_of(command), language="none")
            self.state.document.note_implicit_target(section, section)
            yield section


def setup(app: Sphinx) -> dict[str, bool]:
    """Tells Sphinx."""
    app.add_directive("command-help", CommandHelp)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
