"""Key points of one panorama, as bearings on the sphere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require, require_array


@dataclass(frozen=True, eq=False)
class Features(Record):
    """Key points of one panorama, the strongest of each detector first.

    Attributes:
        bearings: (N, 3) float64 unit rays in the camera frame.
        descriptors: (N, D) float32 (compared by Euclidean distance) or uint8 (compared by Hamming distance).
        sizes_rad: (N,) float32 angular diameter of the patch that was described.
        scores: (N,) float32 strength of the detector's response.
        colors_rgb: (N, 3) uint8 colour of the panorama at the key point.
        metric: "l2" or "hamming".
        size_hw: (height, width) of the panorama in which they were detected.
        learned: number of key points, the last ones, that the network ALIKED found and LightGlue can match.
        ups: directions of the camera frame that may be the zenith; views were levelled by each for the network.
        per_up: number of learned key points in the views of each of `ups`, in their order; empty: all in the first's.
        walls_from_cam: (3, 3) rotation into a frame whose y points down and whose x and z are along walls at right
            angles, by the lines of the picture; None if it shows none, or nothing has looked for them.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    bearings: NDArray[np.float64]
    descriptors: NDArray[np.float32] | NDArray[np.uint8]
    sizes_rad: NDArray[np.float32]
    scores: NDArray[np.float32]
    colors_rgb: NDArray[np.uint8]
    metric: Literal["l2", "hamming"]
    size_hw: tuple[int, int]
    learned: int = 0
    ups: tuple[tuple[float, float, float], ...] = ((0.0, -1.0, 0.0),)
    per_up: tuple[int, ...] = ()
    walls_from_cam: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        """Convert the tuples, which are stored as lists."""
        object.__setattr__(self, "ups", tuple((x, y, z) for x, y, z in self.ups))
        object.__setattr__(self, "per_up", tuple(self.per_up))

    def __len__(self) -> int:
        """Return the number of key points."""
        return len(self.bearings)

    def only_learned(self) -> Features:
        """Return the key points that a network found."""
        return self._part(slice(len(self) - self.learned, None), learned=self.learned)

    def without_learned(self) -> Features:
        """Return the key points that no network found."""
        return replace(self._part(slice(0, len(self) - self.learned), learned=0), per_up=())

    def _part(self, chosen: slice, *, learned: int) -> Features:
        names = ("bearings", "descriptors", "sizes_rad", "scores", "colors_rgb")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names}, learned=learned)

    def check(self) -> None:
        """Raise ContractError unless all arrays agree and the bearings are unit vectors."""
        count = len(self.bearings)
        require_array(self, "bearings", dtype=np.float64, shape=(None, 3))
        lengths = np.linalg.norm(self.bearings, axis=1)
        require(bool(np.all(np.abs(lengths - 1) < 1e-6)), self, "bearings must be unit vectors")
        dtype = np.float32 if self.metric == "l2" else np.uint8
        require_array(self, "descriptors", dtype=dtype, shape=(count, None))
        require_array(self, "sizes_rad", dtype=np.float32, shape=(count,))
        require_array(self, "scores", dtype=np.float32, shape=(count,))
        require_array(self, "colors_rgb", dtype=np.uint8, shape=(count, 3))
        require(len(self.ups) > 0, self, "ups must contain a direction")
        counts = self.per_up or (self.learned,)
        counted = (len(counts), sum(counts)) == (len(self.ups), self.learned) and min(counts) >= 0
        require(counted or not self.learned, self, "per_up must state for each of ups how many key points are learned")
        if self.walls_from_cam is not None:
            require_array(self, "walls_from_cam", dtype=np.float64, shape=(3, 3))
            turned_back = self.walls_from_cam @ self.walls_from_cam.T
            require(bool(np.allclose(turned_back, np.eye(3), atol=1e-4)), self, "walls_from_cam is not a rotation")


@dataclass(frozen=True, eq=False)
class GlobalDescriptor(Record):
    """Global descriptor of a panorama; similar panoramas have vectors with a large scalar product.

    Attributes:
        vector: (D,) float32 of about the same length for all panoramas; zero for a panorama without key points.
        sample: (S, B) int16 descriptors of a few key points; matching them against the sample of
            another panorama identifies neighbours far better than the vectors do. May be empty.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    vector: NDArray[np.float32]
    sample: NDArray[np.int16] = field(default_factory=lambda: np.zeros((0, 0), np.int16))

    def check(self) -> None:
        """Raise ContractError unless the arrays have their shapes and types, and the vector is finite."""
        require_array(self, "vector", dtype=np.float32, shape=(None,))
        require_array(self, "sample", dtype=np.int16, shape=(None, None))


@dataclass(frozen=True, eq=False)
class WeakImage(Record):
    """Whether an image needs learned key points."""

    axis: ClassVar[Axis | None] = Axis.IMAGE

    wanted: bool


@dataclass(frozen=True, eq=False)
class WeakImages(Record):
    """Which images of a capture are weakly matched."""

    axis: ClassVar[Axis | None] = Axis.ONE
    explodes_into: ClassVar[type[Record] | None] = WeakImage

    weak: tuple[str, ...] = field(default=())  # names of these images
    similar: tuple[str, ...] = field(default=())  # names of other images that they may match
    others: tuple[str, ...] = field(default=())  # names of all other images

    def __post_init__(self) -> None:
        """Convert the names, which are stored as lists."""
        for name in ("weak", "similar", "others"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    def explode(self) -> Mapping[str, WeakImage]:
        """Return for each image whether it needs learned key points."""
        wanted = {*self.weak, *self.similar}
        return {name: WeakImage(name in wanted) for name in (*self.weak, *self.similar, *self.others)}
