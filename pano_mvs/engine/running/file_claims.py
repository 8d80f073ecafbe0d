"""Decide which unit delivers a file if several units would write it, whichever of them is computed first."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import PurePosixPath
from types import MappingProxyType
from typing import NamedTuple

from pano_mvs.core.errors import UsageError


class NameClashError(UsageError):
    """A unit would write the same file as another unit of its stage, or write a file twice.

    Attributes:
        losers: units of the same stage whose files were withdrawn because they clash with those of this unit: item to
            the reason.
    """

    def __init__(self, text: str, losers: Mapping[str, str] = MappingProxyType({})) -> None:
        self.losers = losers
        super().__init__(text)


class Owner(NamedTuple):
    """The unit that a file belongs to."""

    stage: str
    item: str


class Claim(NamedTuple):
    """The result of a claim.

    Attributes:
        refusal: why the unit cannot deliver its files; empty if it can.
        losers: units of the same stage that have to withdraw their files: item to the reason.
    """

    refusal: str
    losers: dict[str, str]


class FileClaims:
    """The files that the units of one pass deliver, or would deliver if they did not clash with others.

    Of the units of a stage that claim the same file, the first one in the order of the capture gets it. The others
    deliver nothing, but their claims on other files still count, so that the result does not depend on the order in
    which claims are made.
    """

    def __init__(self, order: Callable[[Owner], tuple[int, str]]) -> None:
        """Start without claims; `order` returns the sort key of a unit."""
        self._order = order
        self._owners: dict[str, Owner] = {}  # file to the first unit that claims it, whether or not it delivers
        self._folders: set[str] = set()
        self._delivered: set[Owner] = set()
        self._lost: dict[Owner, tuple[str, ...]] = {}  # unit that cannot deliver to the files that it claims

    def claim(self, owner: Owner, files: Collection[str]) -> Claim:
        """Enter the files of a unit; call `deliver` once they are written.

        Raises:
            UsageError: if another stage writes one of the files.
        """
        claim = self._resolve(owner, files)
        for loser in claim.losers:
            other = Owner(owner.stage, loser)
            self._delivered.remove(other)
            self._lost[other] = tuple(name for name, found in self._owners.items() if found == other)
        for name in files:
            self._owners[name] = min(owner, self._owners.get(name, owner), key=self._order)
            self._folders.update(folders_of(name))
        if claim.refusal:
            self._lost[owner] = tuple(files)
        return claim

    def deliver(self, owner: Owner) -> None:
        """Record that the files of a unit have been written."""
        self._delivered.add(owner)

    def lost_files(self, owner: Owner) -> tuple[str, ...]:
        """Return the files that a unit claims but cannot deliver."""
        return self._lost[owner]

    def refusals(self) -> dict[tuple[str, str], str]:
        """Return why units could not deliver, independent of the order of claims: stage and item to the reason."""
        return {
            (owner.stage, owner.item): next(
                _reason(what, other.item)
                for what, other in self._clashes(owner, files)
                if self._order(other) < self._order(owner)
            )
            for owner, files in self._lost.items()
        }

    def _resolve(self, owner: Owner, files: Collection[str]) -> Claim:
        refusal, losers = "", {}
        for what, other in self._clashes(owner, files):
            if other.stage != owner.stage:
                raise UsageError(
                    f"stages {other.stage!r} and {owner.stage!r} both write {what}; give one of them a folder of its "
                    "own with `to: NAME`"
                )
            if self._order(owner) > self._order(other):
                refusal = refusal or _reason(what, other.item)
            elif other in self._delivered:
                losers[other.item] = _reason(what, owner.item)
        return Claim(refusal, losers)

    def _clashes(self, owner: Owner, files: Iterable[str]) -> Iterator[tuple[str, Owner]]:
        """Yield the clashes of some files: a description, and the other unit."""
        for name in files:
            if (other := self._owners.get(name)) is not None and other != owner:
                yield name, other
            for folder in folders_of(name):
                if (other := self._owners.get(folder)) is not None and other != owner:
                    yield f"{folder}, as a file and as a folder,", other
            if name in self._folders:
                inside = {other for path, other in self._owners.items() if path.startswith(f"{name}/")}
                yield from ((f"{name}, as a file and as a folder,", other) for other in sorted(inside - {owner}))


def folders_of(name: str) -> list[str]:
    """Return the folders of a file, inside the output folder."""
    return [str(folder) for folder in PurePosixPath(name).parents if folder.parts]


def _reason(what: str, other: str) -> str:
    return (
        f"{what} is delivered for {other} too. Rename one of the images or their folders, or, in the stage, put "
        "{item} or {name} into the names of the files"
    )
