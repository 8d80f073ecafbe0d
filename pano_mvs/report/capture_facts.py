"""The capture that a report is about: its name, the number and sizes of its panoramas, and the date of the run."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePath

from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary

_MAX_MEASURED = 100
_MAX_SIZES = 4
# Names of folders that do not say which capture it is: the name of the folder above comes first.
_GENERIC = {
    "images",
    "image",
    "img",
    "photos",
    "pictures",
    "panoramas",
    "panos",
    "frames",
    "input",
    "jpg",
    "png",
    "raw",
}
_MONTHS = "Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"


@dataclass(frozen=True)
class CaptureFacts:
    """The capture of a run.

    Attributes:
        name: of the folder with the images, or else of the workflow.
        date: when the run began, in words; "" if unknown.
        panoramas: number of images of the capture.
        sizes: ((height, width) of the full sphere in the file, number of images), the most frequent size first.
        measured: number of images whose size was looked up: at most 100, evenly spaced.
        working_hw: (height, width) at which most images are processed; None if that is the size of the files.
    """

    name: str
    date: str
    panoramas: int
    sizes: tuple[tuple[tuple[int, int], int], ...] = ()
    measured: int = 0
    working_hw: tuple[int, int] | None = None


def capture_facts(summary: RunSummary, values: StoredValues, *, panoramas: int) -> CaptureFacts:
    """Return what is known of the capture of a run; `panoramas` is its number of images."""
    names = list(values.refs.get("images", {}))
    known = [values.panorama(name) for name in names[:: -(-len(names) // _MAX_MEASURED) or 1]]
    found = [panorama for panorama in known if panorama is not None]
    sizes = Counter(panorama.source_size_hw for panorama in found)
    working = Counter(panorama.size_hw for panorama in found).most_common(1)
    same = bool(found) and all(panorama.size_hw == panorama.source_size_hw for panorama in found)
    return CaptureFacts(
        capture_name(summary),
        date_in_words(summary.started),
        panoramas,
        tuple(sizes.most_common(_MAX_SIZES)),
        len(found),
        working[0][0] if working and not same else None,
    )


def capture_name(summary: RunSummary) -> str:
    """Return the name of the folder or video with the images, else that of the workflow.

    >>> stages = [{"name": "images", "use": "source.folder", "params": {"path": "/tours/old mill/images"}}]
    >>> capture_name(RunSummary.from_json({"stages": stages}))
    'old mill / images'
    """
    folder = summary.source_folder
    path = PurePath(folder) if folder is not None else PurePath()
    if not path.name:
        return summary.workflow.name
    parent = path.parent.name
    return f"{parent} / {path.name}" if parent and path.name.lower() in _GENERIC else path.name


def date_in_words(started: str) -> str:
    """Return a date and time of ISO 8601 in words; other texts as they are.

    >>> date_in_words("2026-11-02T18:10:03+00:00")
    '2 Nov 2026, 18:10 UTC'
    """
    try:
        when = datetime.fromisoformat(started)
    except ValueError:
        return started
    zone = " UTC" if when.tzinfo is not None else ""
    when = when.astimezone(UTC) if zone else when
    return f"{when.day} {_MONTHS[when.month - 1]} {when.year}, {when:%H:%M}{zone}"
