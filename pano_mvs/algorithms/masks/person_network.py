"""The neural networks that find people: MediaPipe's selfie segmentation and pose landmarks, run by OpenCV."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import resources

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import StoreError

SIDE_PX = 256
"""Width and height of the pictures that the networks read."""

# By the digest, another file means another code, so that no result of the old one is taken from a cache.
_SEGMENTATION = ("selfie_segmentation.tflite", "8d13b7fae74af625c641226813616a2117bd6bca19eb3b75574621fc08557f27")
_POSE = ("pose_landmark_lite.tflite", "f17bfbecadb61c3be1baa8b8d851cc6619c870a87167b32848ad20db306b9d61")


def person_probability(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how likely each pixel shows a person, (256, 256) in [0, 1], of an upright picture of one person or none.

    The network was trained on people who fill a large part of an upright picture. On its own it also finds floors,
    tables and stairs; see `people`.

    Args:
        picture: (256, 256, 3) uint8 RGB.
    """
    output = _output(_SEGMENTATION, picture, None)
    return np.clip(output.reshape(SIDE_PX, SIDE_PX), 0, 1)


def person_outline(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how likely each pixel shows what an upright picture shows in its middle, (256, 256) in [0, 1].

    It is the segmentation of the network for poses, which outlines a person in the middle more exactly than
    `person_probability` and works for whole bodies. Without a person, it outlines some other object.

    Args:
        picture: (256, 256, 3) uint8 RGB.
    """
    logits = _output(_POSE, picture, "Identity_2").reshape(SIDE_PX, SIDE_PX)
    return np.asarray(1 / (1 + np.exp(-np.clip(logits, -30, 30))), np.float32)


def person_presence(picture: NDArray[np.uint8]) -> float:
    """Return how likely an upright picture shows a person in its middle, in [0, 1].

    It is the flag by which the network for poses says whether its landmarks mean anything.

    Args:
        picture: (256, 256, 3) uint8 RGB.
    """
    return float(_output(_POSE, picture, "Identity_1").reshape(-1)[0])


def _output(model: tuple[str, str], picture: NDArray[np.uint8], name: str | None) -> NDArray[np.float32]:
    """Return an output of a network, its only one without a name."""
    network = _network(*model)
    network.setInput(cv2.dnn.blobFromImage(picture, 1 / 255))
    return np.asarray(network.forward() if name is None else network.forward(name), np.float32)


@cache
def _network(file: str, digest: str) -> cv2.dnn.Net:
    """Return a network, loaded once per process."""
    content = (resources.files("pano_mvs.algorithms.masks") / "models" / file).read_bytes()
    if hashlib.sha256(content).hexdigest() != digest:
        raise StoreError(f"{file}: this file of the package is damaged. Install pano-mvs again")
    return cv2.dnn.readNetFromTFLite(np.frombuffer(content, np.uint8))
