"""Choose keyframes of a panoramic video by parallax: one pass, with at most a second of small images in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.keyframes.parallax import GreyImage, ParallaxTracker

# A keyframe is chosen among the frames whose parallax is between these multiples of the wanted one.
_OPENS, _CLOSES = 0.7, 1.25
_MAX_WAIT_S = 1.0  # the first possible frame waits at most this time for sharper ones
_FIRST_S = 0.4  # the first keyframe is among the frames of this time
_LOST_SHARE = 0.3
_LOST_S = 0.5  # frames without known points for this time show another place
_SHARP_SHARE = 0.9  # of the sharpness of the sharpest candidate
_MIN_POINTS = 30
_LATE_S = 0.1  # frames this shortly before the maximum time may be chosen, too
_EPSILON_S = 1e-6
_BY_TIME_S = 1.0  # between keyframes if there is nothing to measure motion by


@dataclass(frozen=True)
class KeyframeSettings:
    """When to take a keyframe.

    Attributes:
        parallax_deg: median parallax between a keyframe and the next.
        min_s: minimum time between them.
        max_s: maximum time between them, even if the camera stands; None for no maximum.
    """

    parallax_deg: float
    min_s: float
    max_s: float | None


@dataclass(frozen=True, eq=False)
class SmallFrame:
    """A frame of a video, as far as it is needed to choose keyframes.

    Attributes:
        time_s: its time.
        grey: (128, 256) uint8.
        sharpness: any measure that compares frames of the same scene.
        parallax_deg: of a keyframe, its parallax to the one before.
    """

    time_s: float
    grey: GreyImage
    sharpness: float
    parallax_deg: float = 0.0


def select_keyframes(
    frames: Iterable[SmallFrame], settings: KeyframeSettings, mask: NDArray[np.bool_] | None = None
) -> Iterator[SmallFrame]:
    """Yield the keyframes of a video.

    A keyframe follows when the scene has moved by the wanted parallax, rotation of the camera not counted. Of the
    frames around this point, a sharp one is chosen. A camera that stands still, or only turns, gives no keyframe.

    Args:
        frames: in the order of the video, about 5 to 30 per second.
        settings: when to take a keyframe.
        mask: (128, 256) bool, pixels that may be used; None for all.
    """
    selector = _Selector(settings, mask)
    for frame in frames:
        yield from selector.add(frame)
    yield from selector.finish()


@dataclass(frozen=True)
class _State:
    """What follows from a frame.

    Attributes:
        may_be_chosen: whether it may become the next keyframe.
        must_be_chosen: whether the next keyframe must be chosen now.
        is_lost: whether too few known points are seen.
        is_elsewhere: whether this has lasted, as after a cut.
    """

    may_be_chosen: bool
    must_be_chosen: bool
    is_lost: bool
    is_elsewhere: bool


class _Selector:
    def __init__(self, settings: KeyframeSettings, mask: NDArray[np.bool_] | None) -> None:
        self.settings = settings
        self.tracker = ParallaxTracker(mask)
        self.last: SmallFrame | None = None
        self.candidates: list[SmallFrame] = []
        self.seen: list[SmallFrame] = []  # since the first candidate
        self.lost_since: float | None = None

    def add(self, frame: SmallFrame) -> Iterator[SmallFrame]:
        """Yield the keyframes that a further frame completes."""
        waiting = deque([frame])
        while waiting:
            chosen = self._looked_at(waiting.popleft())
            if chosen is not None:
                # The frames after the chosen one are compared with it.
                later = self.candidates if self.last is None else self.seen
                waiting.extendleft(reversed([other for other in later if other.time_s > chosen.time_s]))
                self._begin_at(chosen)
                yield chosen

    def finish(self) -> Iterator[SmallFrame]:
        """Yield the last keyframe if the video ended while frames were waiting for better ones."""
        if self.candidates:
            yield self._best()

    def _looked_at(self, frame: SmallFrame) -> SmallFrame | None:
        """Return the keyframe that is complete with a frame, or None."""
        if self.last is None:
            self.candidates.append(frame)
            return self._best() if frame.time_s - self.candidates[0].time_s >= _FIRST_S else None
        frame, state = self._compared(frame, self.last)
        self.seen.append(frame)
        if state.may_be_chosen:
            self.candidates.append(frame)
        elif state.is_elsewhere and not self.candidates:
            self.candidates += self.seen
        elif not state.is_lost and not self.candidates:
            self.seen.clear()
        if not self.candidates:
            return None
        has_waited = frame.time_s - self.candidates[0].time_s >= _MAX_WAIT_S
        return self._best() if state.must_be_chosen or state.is_elsewhere or has_waited else None

    def _compared(self, frame: SmallFrame, last: SmallFrame) -> tuple[SmallFrame, _State]:
        """Return a frame with its parallax to the last keyframe, and what follows from it."""
        wanted_deg, since = self.settings.parallax_deg, frame.time_s - last.time_s
        is_plain = self.tracker.points < _MIN_POINTS
        motion = self.tracker.measure(frame.grey)
        is_lost = not is_plain and motion.seen_share < _LOST_SHARE
        if not is_lost:
            self.lost_since = None
        elif self.lost_since is None:
            self.lost_since = frame.time_s
        parallax = 0.0 if is_lost or is_plain else float(np.degrees(motion.parallax_rad))
        longest = min(_BY_TIME_S, self.settings.max_s or _BY_TIME_S) if is_plain else self.settings.max_s
        is_late = longest is not None and since >= longest - _EPSILON_S
        is_too_late = longest is not None and since > longest + _EPSILON_S and bool(self.candidates)
        is_nearly_late = longest is not None and since >= longest - _LATE_S
        is_soon = since < self.settings.min_s - _EPSILON_S or is_too_late
        is_elsewhere = self.lost_since is not None and frame.time_s - self.lost_since >= _LOST_S
        return replace(frame, parallax_deg=parallax), _State(
            may_be_chosen=not is_soon and not is_lost and (parallax >= _OPENS * wanted_deg or is_nearly_late),
            must_be_chosen=parallax >= _CLOSES * wanted_deg or is_late,
            is_lost=is_lost,
            is_elsewhere=is_elsewhere and not is_soon,
        )

    def _best(self) -> SmallFrame:
        """Return the candidate nearest to the wanted parallax, of those that are about as sharp as the sharpest."""
        needed = _SHARP_SHARE * max(frame.sharpness for frame in self.candidates)
        sharp = [frame for frame in self.candidates if frame.sharpness >= needed]
        return min(sharp, key=lambda frame: (abs(frame.parallax_deg - self.settings.parallax_deg), frame.time_s))

    def _begin_at(self, keyframe: SmallFrame) -> None:
        self.last = keyframe
        self.tracker.anchor(keyframe.grey)
        self.candidates, self.seen, self.lost_since = [], [], None
