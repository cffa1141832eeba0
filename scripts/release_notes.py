"""Print what CHANGELOG.md says of the version that a tag names; refuse the tag where the project says otherwise.

    python scripts/release_notes.py v0.1.0

The package, the citation, the conda recipe and the changelog must all name the tag's version, and citation and
changelog the same day. Needs only Python's standard library.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Where the version and the day of a release are written.
_VERSION = (
    ("src/difftetvr/_version.py", r'^__version__ = "(.+)"$'),
    ("CITATION.cff", r"^version: (.+)$"),
    ("packaging/conda-forge/recipe.yaml", r'^  version: "(.+)"$'),
)
_DAY = r"^date-released: (.+)$"


def release_notes(tag: str, root: Path = ROOT) -> str:
    """The changelog's section of a release.

    Args:
        tag: The git tag, v and the version.
        root: The project's folder.

    Raises:
        ValueError: Tag and project disagree; the message is a sentence that says where.
    """
    version = tag.removeprefix("v")
    if tag == version:
        raise ValueError(f"The tag {tag} does not begin with v.")
    for file, pattern in _VERSION:
        if (written := _find(root / file, pattern)) != version:
            raise ValueError(f"The tag is {tag}, but {file} says {written}.")
    sections = re.split(r"^## ", (root / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    for section in sections[1:]:
        title, _, notes = section.partition("\n")
        if title.startswith(f"[{version}] - "):
            break
    else:
        raise ValueError(f"CHANGELOG.md has no section '## [{version}] - YYYY-MM-DD'.")
    day = title.removeprefix(f"[{version}] - ").strip()
    if (cited := _find(root / "CITATION.cff", _DAY)) != day:
        raise ValueError(f"CHANGELOG.md says {version} was released on {day}, CITATION.cff says {cited}.")
    if not notes.strip():
        raise ValueError(f"CHANGELOG.md says nothing of {version}.")
    return notes.strip() + "\n"


def _find(path: Path, pattern: str) -> str | None:
    found = re.search(pattern, path.read_text(encoding="utf-8"), re.MULTILINE)
    return found[1].strip() if found else None


def main() -> int:
    """Print the notes; 1 and a sentence where tag and project disagree."""
    if len(sys.argv) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        print(release_notes(sys.argv[1]), end="")
    except ValueError as error:
        print(f"release_notes: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
