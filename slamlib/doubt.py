"""The record of a doubt: a contradiction between the measurements and the files of a drive."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Doubt:
    """A possible error in the files of a drive, for the user to check.

    `what` is its kind in kebab case ("wheels-swapped"), for programs. `sentence` states the
    evidence and what to check in which file.
    """

    what: str
    sentence: str
