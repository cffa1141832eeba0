"""Options: what they must be, and how they are read from JSON, checked against the types that their dataclass declares.

An error names an option by its whole path, such as ``exchange.share``, and says nothing of where the options come from:
who read them does.
"""

from __future__ import annotations

import dataclasses
import difflib
import reprlib
from typing import Any, ClassVar, TypeVar

import numpy as np

from difftetvr.declared import as_declared, declared_types, in_words, require_declared
from difftetvr.errors import FitError, shown

LARGEST_COUNT = 2**31 - 1
"""Greatest value of options that count something."""

_Options = TypeVar("_Options")

# Independent streams of random numbers: order of views, what a step does with them, what refinements are judged on.
_VIEW_STREAM, _STEP_STREAM, _REFINEMENT_STREAM = range(3)


def require(condition: bool, name: str, value: object, rule: str) -> None:
    """Checks an option.

    Raises:
        FitError: The condition does not hold; names option, value and rule.
    """
    if not condition:
        raise FitError(f"The option {name} is {value if isinstance(value, str) else shown(value)}; it must be {rule}.")


class OptionGroup:
    """Base of dataclasses whose options are one of those of a run.

    They are checked when they are made, which is before the run's options are; so they must know by themselves what
    they are called there.

    Attributes:
        prefix: What stands before their names in those of a run.
    """

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        require_declared(self, FitError, f"option {self.prefix}")

    def _require(self, condition: bool, name: str, rule: str) -> None:
        require(condition, f"{self.prefix}{name}", getattr(self, name), rule)


class RunOptions:
    """Base of options of a run that saves its state. Subclasses are dataclasses.

    Attributes:
        free: Options that a resumed run may choose anew: what changes nothing about where the optimisation goes, and
            how far it goes.
        checkpoint_seconds: Seconds between checkpoints.
        evaluate_every: Iterations between glances at held-out views; 0: never.
    """

    free: ClassVar[frozenset[str]]
    checkpoint_seconds: float
    evaluate_every: int = 0

    @property
    def steps(self) -> int:
        """Number of optimisation steps."""
        raise NotImplementedError

    def _require_counts(self, ranges: dict[str, tuple[int, int]]) -> None:
        """Checks options that count something, where they are not left open.

        Args:
            ranges: Least and greatest value by name.

        Raises:
            FitError: One is out of range.
        """
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            require(value is None or least <= value <= most, name, value, f"at least {least} and at most {most}")

    def require_same_run(self, other: RunOptions) -> None:
        """Checks that ``other`` would take the same steps as these options of a saved run, were it of the same length.

        Raises:
            FitError: An option that decides the steps differs; names the first one.
        """
        differing = _first_difference(self._comparable(), other._comparable(), self.free)
        if differing is not None:
            name, mine, theirs = differing
            raise FitError(
                f"The saved run has {name} = {mine}, this run asks for {theirs}; resume with the same options or start "
                "anew."
            )

    def _comparable(self) -> RunOptions:
        """The options as other runs' are compared with them: with values for those that older runs did not have."""
        return self

    def to_json(self) -> dict[str, Any]:
        """The options as JSON values."""
        return dataclasses.asdict(self)  # type: ignore[call-overload]

    @classmethod
    def from_json(cls: type[_Options], values: object) -> _Options:
        """The inverse of :meth:`to_json`.

        Raises:
            FitError: An option is unknown, of the wrong type or out of range.
        """
        return options_from_json(cls, values)


class Schedule(RunOptions):
    """Base of options of a run that optimises something and moves a mesh: which views and rates a step has.

    All of it is a function of the options and the iteration alone, so a resumed run sees what an uninterrupted one
    would have seen. Subclasses have the fields that are named here.
    """

    seed: int
    rate: float
    final_rate: float
    move: bool
    motion: Any

    @property
    def batch(self) -> int:
        """Training views per step."""
        raise NotImplementedError

    def rate_at(self, iteration: int) -> float:
        """Learning rate of a step, log-linear from ``rate`` (iteration 0) to ``final_rate`` (the last one)."""
        fraction = iteration / max(self.steps - 1, 1)
        return self.rate * (self.final_rate / self.rate) ** fraction

    def motion_rate_at(self, iteration: int) -> float | None:
        """Length of the vertices' steps, in altitudes; None where they stay."""
        progress = iteration / (self.motion.until * self.steps)
        return float(self.motion.rate_at(progress)) if self.move and progress < 1.0 else None

    def views_at(self, iteration: int, view_count: int) -> list[int]:
        """Positions, in [0, view_count), of the training views of a step.

        The views are shuffled anew in each pass over them.
        """
        first = iteration * self.batch
        return [self._view(k, view_count) for k in range(first, first + self.batch)]

    def refinement_random(self, iteration: int) -> np.random.Generator:
        """Chance for what a refinement is judged on.

        Args:
            iteration: Iterations done.
        """
        return self._random(_REFINEMENT_STREAM, iteration)

    def refinement_views_at(self, iteration: int, count: int, view_count: int) -> list[int]:
        """Positions, in [0, view_count), of the random training views that a refinement is judged on.

        Args:
            iteration: Iterations done.
            count: How many; all views where there are fewer.
            view_count: Number of training views.
        """
        return [int(k) for k in self.refinement_random(iteration).permutation(view_count)[:count]]

    def step_random(self, iteration: int) -> np.random.Generator:
        """Chance for what a step does with its views."""
        return self._random(_STEP_STREAM, iteration)

    def _view(self, position: int, view_count: int) -> int:
        epoch, offset = divmod(position, view_count)
        return int(self._random(_VIEW_STREAM, epoch).permutation(view_count)[offset])

    def _random(self, stream: int, number: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, stream, number])


def options_from_json(kind: type[_Options], values: object, path: str = "") -> _Options:
    """An instance of a dataclass from JSON values by field name; fields that are not given keep their defaults.

    JSON knows no tuples: lists stand for them.

    Args:
        kind: Dataclass whose fields are bool, int, float, str, None, literals, tuples, unions of these, or such
            dataclasses.
        values: Parsed JSON.
        path: Name of the option that holds these, for errors.

    Raises:
        DiffTetError: It is no JSON object, an option is unknown, is missing, or its value has another type than its
            field, a FitError; or what the dataclass itself raises for values out of range.
    """
    if not isinstance(values, dict):
        subject = f"The option {path} is" if path else "The options are"
        raise FitError(f'{subject} no JSON object; write {{"option": value, ...}}.')
    declared = declared_types(kind)
    options: dict[str, Any] = {}
    for name, value in values.items():
        full = f"{path}.{name}" if path else name
        if name not in declared:
            alike = difflib.get_close_matches(name, declared, 1)
            hint = f" (is it '{alike[0]}'?)" if alike else ""
            raise FitError(f"There is no option '{full}'; correct its name{hint} or remove it.")
        if dataclasses.is_dataclass(declared[name]):
            options[name] = options_from_json(declared[name], value, full)
            continue
        try:
            options[name] = as_declared(value, declared[name])
        except ValueError:
            # Cut short: the value may be of any length and depth.
            require(False, full, reprlib.repr(value), in_words(declared[name], is_json=True))
    for item in dataclasses.fields(kind):  # type: ignore[arg-type]
        if item.name not in options and not _has_default(item):
            raise FitError(f"The option '{item.name}' is missing{f' in {path}' if path else ''}; add it.")
    return kind(**options)


def _first_difference(
    first: Any, second: Any, free: frozenset[str], prefix: str = ""
) -> tuple[str, object, object] | None:
    """Name and both values of the first option in which two runs differ; None if there is none.

    Args:
        first, second: Their options.
        free: Names of those that may.
        prefix: What stands before the names.
    """
    for item in dataclasses.fields(first):
        name, mine, theirs = f"{prefix}{item.name}", getattr(first, item.name), getattr(second, item.name)
        if name in free or mine == theirs:
            continue
        within = _first_difference(mine, theirs, free, f"{name}.") if dataclasses.is_dataclass(mine) else None
        return within or (name, mine, theirs)
    return None


def _has_default(item: dataclasses.Field[Any]) -> bool:
    return item.default is not dataclasses.MISSING or item.default_factory is not dataclasses.MISSING
