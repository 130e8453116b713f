"""A guard around optional checks: one that fails or does not apply is reported as not tested, and never stops a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

Found = TypeVar("Found")


class NotTested(Exception):
    """A check cannot be applied to this data; the message says why."""


@dataclass
class Guard:
    """Runs checks, and remembers those that failed.

    Attributes:
        not_tested: reasons by name of the check.

    Example:
        >>> from noiseflow.checks import Guard
        >>> guard = Guard()
        >>> guard("division", lambda: 1 / 0, otherwise=0.0), guard.not_tested
        (0.0, {'division': 'ZeroDivisionError: division by zero'})
    """

    not_tested: dict[str, str] = field(default_factory=dict)

    def __call__(self, name: str, check: Callable[[], Found], *, otherwise: Found) -> Found:
        """What the check finds; if it raises, `otherwise`, and its name and reason are remembered."""
        try:
            return check()
        except NotTested as reason:
            self.not_tested[name] = str(reason)
        except Exception as error:  # any fault of an optional check, so that no result is lost
            self.not_tested[name] = f"{type(error).__name__}: {error}"
        return otherwise

    def in_words(self) -> str | None:
        """One line for a terminal or a report; None if everything was tested."""
        listed = "; ".join(f"{name} ({reason})" for name, reason in self.not_tested.items())
        return f"not tested: {listed}" if listed else None
