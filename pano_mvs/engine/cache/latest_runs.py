"""The cache keys that the latest run of each workflow into each folder used, and pins.

The plan compares them to give reasons, and garbage collection keeps what they name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeAlias

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.core.files import checked_body, read_regular, write_checked
from pano_mvs.core.paths import children, is_file, resolved

Keys: TypeAlias = "dict[str, dict[str, str]]"  # stage to unit to cache key
_PIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class RunEntry:
    """A run or a pin."""

    name: str  # the id of the run, or the name of the pin
    workflow: str
    out: str
    when: str  # end of the run, ISO 8601, UTC
    keys: Keys
    pinned: bool = False
    temporary: tuple[str, ...] = ()  # stages whose results the run does not need any more; none of a pin

    @property
    def units(self) -> int:
        """The number of its units."""
        return sum(len(units) for units in self.keys.values())

    def age_s(self) -> float:
        """Return the time since the end of the run."""
        return (datetime.now(UTC) - datetime.fromisoformat(self.when)).total_seconds()


class RunHistory:
    """The runs and the pins of one cache."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def remember(
        self,
        workflow_id: str,
        keys: Keys,
        *,
        workflow: str,
        out: Path,
        finished: bool = True,
        temporary: Iterable[str] = (),
    ) -> None:
        """Store the keys of a run, replacing those of the last run of the same workflow into the same folder.

        If the run did not finish, the earlier keys of the units that it had not reached are kept. A folder that was
        moved or copied has those of its earlier place.

        Args:
            temporary: stages whose results the run does not need any more; see `dropping`.
        """
        name = f"{workflow_id[:16]}-{digest_from_value(str(resolved(out)))[:16]}"
        if not finished:
            own = _read(self.root / "runs" / f"{name}.json")
            before = own.keys if own is not None else self._keys_of_moved(workflow_id, keys)
            keys = before | {stage: before.get(stage, {}) | units for stage, units in keys.items()}
        when = datetime.now(UTC).isoformat(timespec="seconds")
        self._write("runs", RunEntry(name, workflow, str(resolved(out)), when, keys, temporary=tuple(temporary)))

    def _keys_of_moved(self, workflow_id: str, keys: Keys) -> Keys:
        """Return the keys of the latest run of a workflow if it had a unit in common; else it had another capture."""
        last = self.last_keys(workflow_id)
        common = any(units.items() & last.get(stage, {}).items() for stage, units in keys.items())
        return last if common else {}

    def last_keys(self, workflow_id: str) -> Keys:
        """Return the keys of the latest run of a workflow; empty if there is none."""
        found = sorted(self._paths("runs", f"{workflow_id[:16]}-*.json"), key=lambda path: path.stat().st_mtime_ns)
        entry = _read(found[-1]) if found else None
        return entry.keys if entry is not None else {}

    def entries(self) -> list[RunEntry]:
        """Return all runs and pins, the latest first.

        Raises:
            StoreError: if one is damaged, so that it is not known what it protects.
        """
        return sorted(self.each(), key=lambda entry: (entry.when, entry.name), reverse=True)

    def each(self) -> Iterator[RunEntry]:
        """Yield the runs and the pins one at a time, because a large one takes much memory.

        Raises:
            StoreError: if one is damaged, so that it is not known what it protects.
        """
        for folder in ("runs", "pins"):
            for path in self._paths(folder, "*.json"):
                entry = _read(path)
                if entry is None:
                    raise StoreError(
                        f"{path} is damaged, so that it is not known which results it protects. Run its workflow "
                        "again, or "
                        "delete the file if you do not need these results"
                    )
                yield entry

    def pin(self, run: str, name: str) -> RunEntry:
        """Protect the results of a run from garbage collection, also after later runs.

        Args:
            run: the beginning of its id, or its output folder.
            name: of the pin: letters, digits, dots, hyphens and underscores.

        Raises:
            UsageError: if no run or several runs match, or the name is not valid or taken.
        """
        if not _PIN_NAME.fullmatch(name):
            raise UsageError(
                f"{name!r} is not a valid name of a pin: use letters, digits, dots, hyphens and underscores"
            )
        runs = [entry for entry in self.entries() if not entry.pinned]
        found = [entry for entry in runs if entry.name.startswith(run) or entry.out == str(resolved(Path(run)))]
        if len(found) != 1:
            known = ", ".join(entry.name for entry in found or runs) or "none"
            raise UsageError(f"{len(found)} runs match {run!r}; existing runs: {known}")
        old = found[0]
        if any(entry.pinned and entry.name == name and entry.keys != old.keys for entry in self.entries()):
            raise UsageError(
                f"the pin {name!r} exists and protects other results: choose another name, or delete the pin "
                f"with `cache unpin {name}`"
            )
        pin = RunEntry(name, old.workflow, old.out, old.when, old.keys, pinned=True)
        self._write("pins", pin)
        return pin

    def forget(self, entry: RunEntry) -> None:
        """Remove a run or a pin; its results stay until garbage collection deletes them.

        Raises:
            StoreError: if it cannot be removed.
        """
        delete(self.root / ("pins" if entry.pinned else "runs") / f"{entry.name}.json")

    def _write(self, folder: str, entry: RunEntry) -> None:
        value = {"workflow": entry.workflow, "out": entry.out, "when": entry.when, "keys": entry.keys}
        value |= {"temporary": sorted(entry.temporary)} if entry.temporary else {}
        path = self.root / folder / f"{entry.name}.json"
        write_checked(path, json.dumps(value, sort_keys=True).encode(), temporary_in=self.root / "tmp")

    def _paths(self, folder: str, pattern: str) -> list[Path]:
        return [path for path in children(self.root / folder, pattern) if is_file(path) and path.name[0] != "."]


def delete(path: Path) -> None:
    """Delete a file of a cache; raise StoreError if that is impossible."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{path} cannot be deleted: {error.strerror}. Check the permissions of the cache") from error


def _read(path: Path) -> RunEntry | None:
    try:
        value = json.loads(checked_body(read_regular(path)))
        workflow, out, when = (str(value[name]) for name in ("workflow", "out", "when"))
        if datetime.fromisoformat(when).utcoffset() is None or not "1970" < when[:4] < "9999":
            raise ValueError("not the time of a run")
        keys = {str(stage): {str(item): str(key) for item, key in of.items()} for stage, of in value["keys"].items()}
        temporary = tuple(map(str, value.get("temporary", ())))
        return RunEntry(path.stem, workflow, out, when, keys, path.parent.name == "pins", temporary)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
