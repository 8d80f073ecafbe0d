"""Match pairs of images of different groups, with further descriptors of their images if these can be loaded."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.features.squeezed import squeezed_layers
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.descriptor_layers import DescriptorLayer, RatedMatches, match_layers
from pano_mvs.scene import Features

Pair = tuple[int, int]
LoadPicture = Callable[[str], tuple[NDArray[np.uint8], NDArray[np.bool_]]]
"""Returns a panorama (H, W, 3) uint8 RGB and its mask (H, W) by its name."""

KEPT_IMAGES = 256
"""Images whose further descriptors are kept; those of an image that is not among them are computed again."""


class PairMatcher:
    """Matches pairs of images; the result of a pair is computed once."""

    def __init__(self, features: Mapping[str, Features], load: LoadPicture | None = None) -> None:
        """Match by the key points alone, or also by squeezed tiles of images that `load` returns.

        Args:
            features: key points by image name, in the capture's order.
            load: loads an image by its name; one image is in memory at a time.
        """
        self._features = features
        self._names = tuple(features)
        self._load = load
        self._layers: OrderedDict[int, tuple[DescriptorLayer, ...]] = OrderedDict()
        self._rated: dict[Pair, RatedMatches] = {}
        self._matched: dict[tuple[Pair, float], NDArray[np.int32]] = {}
        self.described = 0

    def matches(self, pair: Pair, ratio: float) -> NDArray[np.int32]:
        """Return the matches (M, 2) of two images, by their positions in the capture, that pass a ratio test."""
        if pair[0] > pair[1]:
            return self.matches((pair[1], pair[0]), ratio)[:, ::-1]
        first, second = (self._features[self._names[image]] for image in pair)
        if self._load is None or first.metric != "l2":
            if (pair, ratio) not in self._matched:
                self._matched[pair, ratio] = match_features(first, second, ratio=ratio)
            return self._matched[pair, ratio]
        if pair not in self._rated:
            one, other = self._layers_of(pair[0]), self._layers_of(pair[1])
            self._rated[pair] = match_layers(first, second, first_layers=one, second_layers=other)
        return self._rated[pair].below(ratio)

    def _layers_of(self, image: int) -> tuple[DescriptorLayer, ...]:
        assert self._load is not None
        if image not in self._layers:
            name = self._names[image]
            self._layers[image] = squeezed_layers(self._features[name], *self._load(name))
            self.described += 1
            if len(self._layers) > KEPT_IMAGES:
                self._layers.popitem(last=False)
        self._layers.move_to_end(image)
        return self._layers[image]
