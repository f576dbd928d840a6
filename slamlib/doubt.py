"""Doubts: what a drive's own measurements say against its files, each in one sentence."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Doubt:
    """Something about a drive that its user should look at.

    `what` is a short name in kebab case ("wheels-swapped"), for programs. `sentence` says what was
    seen, how decided it is, and what to look at in which file.
    """

    what: str
    sentence: str
