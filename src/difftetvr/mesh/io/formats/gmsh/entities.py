"""Entities of Gmsh's format 4, which say what physical groups their elements belong to, and the groups' names."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from difftetvr.mesh.io.source import Source

_MOST_NAMES = 12


@dataclass
class Groups:
    """What is known of groups.

    Attributes:
        names: Of physical groups, by dimension and tag.
        physical: Tags of the physical groups that an entity belongs to, by its dimension and tag.
    """

    names: dict[tuple[int, int], str] = field(default_factory=dict)
    physical: dict[tuple[int, int], list[int]] = field(default_factory=dict)

    @property
    def names_of_volumes(self) -> dict[int, str]:
        """Names of physical groups of volumes by tag."""
        return {abs(tag): name for (dimension, tag), name in self.names.items() if dimension == 3}

    def of(self, entities: np.ndarray) -> np.ndarray:
        """The first physical group of entities (N, 2), by dimension and tag: (N,), 0 where there is none."""
        pairs, places = np.unique(entities, axis=0, return_inverse=True)
        first = [abs(next(iter(self.physical.get((d, tag), ())), 0)) for d, tag in pairs.tolist()]
        return np.array(first, np.int64)[places.reshape(-1)]

    def notes(self, tags: set[int], entities: set[tuple[int, int]]) -> list[str]:
        """Sentences about names, and about entities in several groups.

        Args:
            tags: Of physical groups of volumes that cells belong to.
            entities: Of the cells; empty in format 2.
        """
        said = [f"{tag} is {name[:80]!r}" for (d, tag), name in sorted(self.names.items()) if d == 3 and tag in tags]
        found = []
        if said:
            more = ", ..." if len(said) > _MOST_NAMES else ""
            found.append(f"Of the physical groups in gmsh:physical, {', '.join(said[:_MOST_NAMES])}{more}.")
        several = [e for e in entities if len(self.physical.get(e, ())) > 1]
        if several:
            found.append(
                "Some cells belong to several physical groups, of which gmsh:physical has the first, as for the volume "
                f"{min(several)[1]}."
            )
        return found


def read_names(source: Source, groups: Groups) -> None:
    """The section PhysicalNames."""
    for _ in range(source.count(source.words("the number of names")[0], "names")):
        words = (source.next_line() or "").split(maxsplit=2)
        if len(words) < 3 or not all(word.lstrip("-").isdigit() for word in words[:2]):
            raise source.damaged("the name of a physical group is incomplete")
        groups.names[int(words[0]), int(words[1])] = words[2].strip().strip('"')


def read_entities(source: Source, groups: Groups, data_size: int | None) -> None:
    """The section Entities of format 4.1, or of 4.0 where the size of numbers is None."""
    size_type = f"u{data_size or 8}"
    counts = source.numbers(4, size_type, "numbers of entities").tolist()
    for dimension, count in enumerate(counts):
        # Points have a position in format 4.1, all else a box.
        reals = 3 if dimension == 0 and data_size is not None else 6
        for _ in range(_possible(source, count)):
            tag = int(source.numbers(1, "i4", "entities")[0])
            source.numbers(reals, "f8", "entities")
            groups.physical[dimension, tag] = _list(source, size_type)
            if dimension:
                _list(source, size_type)  # what bounds it


def read_partitioned_entities(source: Source, groups: Groups, data_size: int | None) -> None:
    """The section PartitionedEntities, whose entities elements are in where a mesh was partitioned.

    Of format 4.1, or of 4.0 where the size of numbers is None, whose numbers of partitions are of 4 bytes.
    """
    size_type, few_type = f"u{data_size or 8}", f"u{data_size or 4}"
    source.numbers(1, few_type, "the number of partitions")
    ghosts = int(source.numbers(1, few_type, "the number of ghost entities")[0])
    source.numbers(2 * ghosts, "i4", "ghost entities")
    counts = source.numbers(4, size_type, "numbers of partitioned entities").tolist()
    for dimension, count in enumerate(counts):
        for _ in range(_possible(source, count)):
            tag, parent_dimension, parent = source.numbers(3, "i4", "partitioned entities").tolist()
            _list(source, few_type)  # its partitions
            source.numbers(3 if dimension == 0 and data_size is not None else 6, "f8", "partitioned entities")
            own = _list(source, size_type)
            groups.physical[dimension, tag] = own or groups.physical.get((parent_dimension, parent), [])
            if dimension:
                _list(source, size_type)


def _list(source: Source, size_type: str) -> list[int]:
    count = int(source.numbers(1, size_type, "entities")[0])
    return source.numbers(count, "i4", "entities").tolist()


def _possible(source: Source, count: int) -> int:
    if count > source.size:
        raise source.damaged(f"it announces {count} entities but has only {source.size} bytes")
    return count
