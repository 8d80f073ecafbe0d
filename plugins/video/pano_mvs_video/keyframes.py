"""Choose keyframes of a panoramic video by parallax, which is measured without the rotation of the camera."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import angle_between, geodesic_angle, nearest_rotation, pixel_from_ray, ray_from_pixel, ray_grid

GreyImage = NDArray[np.uint8]

REDUCED_HW = (128, 256)
"""Size of the panoramas in which motion is measured."""

_PAD = 24  # columns that are repeated on each side of the seam


@dataclass(frozen=True)
class Motion:
    """The motion of the camera since the anchor."""

    parallax_rad: float  # median angle by which points of the scene moved, without the rotation of the camera
    seen_share: float  # share of the points of the anchor that were found again


class ParallaxTracker:
    """Measures the motion of frames relative to one frame, the anchor.

    Each frame is turned back into the orientation of the anchor. Points of the anchor are then searched near their last
    position by pyramidal Lucas–Kanade tracking, always with the anchor's own image as template, so that errors do not
    add up while the camera stands still. The rotation that explains most of their movement is estimated robustly, and
    what remains is parallax.

    `mask`: (128, 256) bool, pixels that may be used; None for all. Points lie within 50° of the equator.
    """

    def __init__(self, mask: NDArray[np.bool_] | None = None) -> None:
        rays = ray_grid(REDUCED_HW)
        usable = np.abs(np.arcsin(rays[..., 1])) < np.radians(50.0)
        if mask is not None:
            usable &= mask
        self._usable = np.zeros((REDUCED_HW[0], REDUCED_HW[1] + 2 * _PAD), np.uint8)
        self._usable[:, _PAD:-_PAD] = 255 * usable
        self._rays = rays.reshape(-1, 3).astype(np.float32)
        self.anchor(np.zeros(REDUCED_HW, np.uint8))

    @property
    def points(self) -> int:
        """The number of points of the anchor; with few of them, motion cannot be measured."""
        return len(self._bearings)

    def anchor(self, grey: GreyImage) -> None:
        """Set the frame, (128, 256) uint8, to which others are compared."""
        self._template = _padded(grey)
        found = cv2.goodFeaturesToTrack(
            self._template,
            maxCorners=160,
            qualityLevel=0.005,
            minDistance=6,
            mask=self._usable,
            useHarrisDetector=False,
        )
        self._corners = np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)
        self._bearings = _bearings(self._corners)
        self._guess = self._bearings
        self._cam_from_anchor = np.eye(3)

    def measure(self, grey: GreyImage) -> Motion:
        """Return the motion of the camera between the anchor and a frame, (128, 256) uint8.

        Frames must come in the order of the video: the rotation and the positions of the points begin with those of the
        previous frame.
        """
        if not self.points:
            return Motion(0.0, 0.0)
        start = self._cam_from_anchor, self._guess
        motion = self._measured(grey)
        if motion.seen_share < 0.5:
            # Perhaps the camera turned quickly: begin again at the heading at which both frames look alike.
            self._cam_from_anchor = start[0] @ _heading(_turned(grey, start[0], self._rays), self._template)
            self._guess = self._bearings
            again = self._measured(grey)
            if again.seen_share > motion.seen_share:
                return again
            self._cam_from_anchor, self._guess = start
        return motion

    def _measured(self, grey: GreyImage) -> Motion:
        parallax, share = 0.0, 0.0
        for _ in range(3):
            found, is_found = self._tracked(_padded(_turned(grey, self._cam_from_anchor, self._rays)))
            share = float(is_found.mean())
            if is_found.sum() < 8:
                return Motion(0.0, share)
            turn = _robust_rotation(self._bearings[is_found], found[is_found])
            residuals = angle_between(self._bearings[is_found] @ turn.T, found[is_found])
            parallax = float(np.median(residuals))
            self._cam_from_anchor = nearest_rotation(self._cam_from_anchor @ turn)
            self._guess = np.where(is_found[:, None], found @ turn, self._guess)
            if float(geodesic_angle(turn, np.eye(3))) < float(np.radians(3)):
                break
        return Motion(parallax, share)

    def _tracked(self, image: GreyImage) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the bearings (N, 3) of the points in an image in the anchor's orientation, and which were found."""
        guess = pixel_from_ray(self._guess, REDUCED_HW) - 0.5
        # Across the seam, the nearest copy of the guess is meant.
        width = REDUCED_HW[1]
        guess[:, 0] += _PAD
        guess[:, 0] -= width * np.round((guess[:, 0] - self._corners[:, 0]) / width)
        before = np.ascontiguousarray(self._corners)
        after, there = _flow(self._template, image, before, guess=guess.astype(np.float32))
        back, here = _flow(image, self._template, after, guess=before.copy())
        returned = np.linalg.norm(back - self._corners, axis=1) < 0.7
        inside = (after[:, 1] > 0) & (after[:, 1] < REDUCED_HW[0] - 1)
        return _bearings(after), there & here & returned & inside


def reduced_grey(frame_bgr: NDArray[np.uint8]) -> GreyImage:
    """Return a frame, (H, W, 3) uint8 BGR, as a grey image of 128 × 256 pixels."""
    step = max(1, frame_bgr.shape[1] // (4 * REDUCED_HW[1]))
    small = cv2.resize(frame_bgr[::step, ::step], REDUCED_HW[::-1], interpolation=cv2.INTER_AREA)
    grey: GreyImage = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
    return grey


def _flow(
    first: GreyImage, second: GreyImage, points: NDArray[np.float32], *, guess: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the positions (N, 2) of points of one image in another one, and which were found."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        first, second, points, guess, winSize=(11, 11), maxLevel=3, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    return found, status.ravel() > 0


def _padded(grey: GreyImage) -> GreyImage:
    return np.ascontiguousarray(np.pad(grey, ((0, 0), (_PAD, _PAD)), mode="wrap"))


def _bearings(padded_px: NDArray[np.float32]) -> FloatArray:
    """Return the rays (N, 3) of positions (N, 2) in a padded image, in which pixel centres have integer positions."""
    return ray_from_pixel(padded_px + np.array((0.5 - _PAD, 0.5)), REDUCED_HW).reshape(-1, 3)


def _turned(grey: GreyImage, cam_from_anchor: FloatArray, rays: NDArray[np.float32]) -> GreyImage:
    """Return a frame as the camera would see it in the orientation of the anchor."""
    x, y, z = (rays @ cam_from_anchor.T.astype(np.float32)).T
    height, width = REDUCED_HW
    columns = (np.arctan2(x, z) / np.float32(2 * np.pi) + np.float32(0.5)) * width - np.float32(0.5)
    rows = (np.arcsin(np.clip(y, -1, 1)) / np.float32(np.pi) + np.float32(0.5)) * height - np.float32(0.5)
    shape = grey.shape
    turned: GreyImage = cv2.remap(
        _padded(grey),
        (columns + _PAD).reshape(shape).astype(np.float32),
        rows.reshape(shape).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.uint8, copy=False)
    return turned


def _heading(turned: GreyImage, template: GreyImage) -> FloatArray:
    """Return the rotation about the vertical under which two frames look most alike."""
    band = slice(REDUCED_HW[0] // 4, -(REDUCED_HW[0] // 4))
    first = np.fft.rfft(template[band, _PAD:-_PAD].astype(np.float64) - template.mean(), axis=1)
    second = np.fft.rfft(turned[band].astype(np.float64) - turned.mean(), axis=1)
    alike = np.fft.irfft((second * first.conj()).sum(axis=0), REDUCED_HW[1])
    angle = 2 * np.pi * int(np.argmax(alike)) / REDUCED_HW[1]
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def _robust_rotation(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the rotation R with after ≈ R before, by iteratively reweighted least squares with a Cauchy-like weight.

    Source: Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32, 1976.
    """
    weights = np.ones(len(before))
    turn = np.eye(3)
    for _ in range(5):
        turn = nearest_rotation((after * weights[:, None]).T @ before)
        weights = 1 / (float(np.radians(0.5)) + angle_between(before @ turn.T, after))
    return turn


_EPSILON_S = 1e-6
_BY_TIME_S = 1.0  # between keyframes if there is nothing to measure motion by


@dataclass(frozen=True)
class KeyframeSettings:
    """When to take a keyframe.

    `parallax_deg`: median parallax between a keyframe and the next. `min_s`: minimum time between them. `max_s`:
    maximum time between them, even if the camera stands; None for no maximum.
    """

    parallax_deg: float
    min_s: float
    max_s: float | None


@dataclass(frozen=True, eq=False)
class SmallFrame:
    """A frame of a video, as far as it is needed to choose keyframes.

    `time_s`: its time. `grey`: (128, 256) uint8. `sharpness`: any measure that compares frames of the same scene.
    `parallax_deg`: of a keyframe, its parallax to the one before.
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

    `frames`: in the order of the video, about 5 to 30 per second. `settings`: when to take a keyframe. `mask`: (128,
    256) bool, pixels that may be used; None for all.
    """
    selector = _Selector(settings, mask)
    for frame in frames:
        yield from selector.add(frame)
    yield from selector.finish()


@dataclass(frozen=True)
class _State:
    """What follows from a frame.

    `may_be_chosen`: whether it may become the next keyframe. `must_be_chosen`: whether the next keyframe must be chosen
    now. `is_lost`: whether too few known points are seen. `is_elsewhere`: whether this has lasted, as after a cut.
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
                self.last = chosen
                self.tracker.anchor(chosen.grey)
                self.candidates, self.seen, self.lost_since = [], [], None
                yield chosen

    def finish(self) -> Iterator[SmallFrame]:
        """Yield the last keyframe if the video ended while frames were waiting for better ones."""
        if self.candidates:
            yield self._best()

    def _looked_at(self, frame: SmallFrame) -> SmallFrame | None:
        """Return the keyframe that is complete with a frame, or None."""
        if self.last is None:
            self.candidates.append(frame)
            # The first keyframe is among the frames of this time.
            return self._best() if frame.time_s - self.candidates[0].time_s >= 0.4 else None
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
        # The first possible frame waits at most this time for sharper ones.
        has_waited = frame.time_s - self.candidates[0].time_s >= 1.0
        return self._best() if state.must_be_chosen or state.is_elsewhere or has_waited else None

    def _compared(self, frame: SmallFrame, last: SmallFrame) -> tuple[SmallFrame, _State]:
        """Return a frame with its parallax to the last keyframe, and what follows from it."""
        wanted_deg, since = self.settings.parallax_deg, frame.time_s - last.time_s
        is_plain = self.tracker.points < 30
        motion = self.tracker.measure(frame.grey)
        is_lost = not is_plain and motion.seen_share < 0.3
        if not is_lost:
            self.lost_since = None
        elif self.lost_since is None:
            self.lost_since = frame.time_s
        parallax = 0.0 if is_lost or is_plain else float(np.degrees(motion.parallax_rad))
        longest = min(_BY_TIME_S, self.settings.max_s or _BY_TIME_S) if is_plain else self.settings.max_s
        is_late = longest is not None and since >= longest - _EPSILON_S
        is_too_late = longest is not None and since > longest + _EPSILON_S and bool(self.candidates)
        # Frames this shortly before the maximum time may be chosen, too.
        is_nearly_late = longest is not None and since >= longest - 0.1
        is_soon = since < self.settings.min_s - _EPSILON_S or is_too_late
        # Frames without known points for this time show another place.
        is_elsewhere = self.lost_since is not None and frame.time_s - self.lost_since >= 0.5
        # A keyframe is chosen among the frames whose parallax is between these multiples of the wanted one.
        return replace(frame, parallax_deg=parallax), _State(
            may_be_chosen=not is_soon and not is_lost and (parallax >= 0.7 * wanted_deg or is_nearly_late),
            must_be_chosen=parallax >= 1.25 * wanted_deg or is_late,
            is_lost=is_lost,
            is_elsewhere=is_elsewhere and not is_soon,
        )

    def _best(self) -> SmallFrame:
        """Return the candidate nearest to the wanted parallax, of those that are about as sharp as the sharpest."""
        needed = 0.9 * max(frame.sharpness for frame in self.candidates)  # of the sharpness of the sharpest candidate
        sharp = [frame for frame in self.candidates if frame.sharpness >= needed]
        return min(sharp, key=lambda frame: (abs(frame.parallax_deg - self.settings.parallax_deg), frame.time_s))
