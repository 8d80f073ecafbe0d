"""Execution of neural networks by ONNX Runtime, and the ONNX files of ALIKED and LightGlue.

These files come with the package; `tools/export_networks.py` writes them. Another folder may hold files of the same
names with the same inputs and outputs, for example with weights of one's own, or the two files that COLMAP downloads.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.core.paths import children, is_file

Provider: TypeAlias = Literal["cpu", "cuda", "coreml", "directml"]
Array: TypeAlias = NDArray[np.float32]

TILE_PX = 512
"""Width and height of the pictures that the detector reads."""
DESCRIPTOR_NORM = 512
"""Length of stored descriptors, whose components are whole numbers as those of SIFT, so that products are exact."""

# By the digests, other files mean other code, so that no result of the old ones is taken from a cache.
DIGESTS: Mapping[str, str] = {
    "aliked_detector.onnx": "e87fa9dee348f3a65f23a02437ad70ea2cc9892fa03acc859069bd749c2d756e",
    "aliked_descriptor.onnx": "5e82ee63a520132462eb6fefc3eb981d005778e94aca378694044c94529e1605",
    "lightglue_start.onnx": "b46f3cba24b9203f1414eb57be9132b30371ded81b9b4934ad8030eb2b2018ed",
    "lightglue_layer.onnx": "ee9cd47d69196a64b6c0a6e97b86554f41152b3def8a3b20ef3101a7c1207c18",
    "lightglue_end.onnx": "012271bd4a563195958c1fa02761e311b080ae6e5b2c787bcce9efb4e30fd920",
}
# Graphics cards do not multiply whole numbers as processors do. A folder of one's own has one file for both.
_FLOAT_LAYER = ("lightglue_layer_float.onnx", "d35e52b2eabb115c0371c72502f2c2b122cbb194579811ed24c53f4ad16ef8aa")
_PACKAGED = Path(__file__).parent / "models"
# Files of COLMAP 4 are recognised by the names and axes of their inputs and outputs, whatever they are called.
_COLMAP: Mapping[Literal["extractor", "matcher"], str] = {
    "extractor": "image (4 axes), max_keypoints (0 axes), min_score (0 axes), keypoints (3 axes), "
    "descriptors (3 axes), scores (2 axes)",
    "matcher": "kpts0 (3 axes), kpts1 (3 axes), desc0 (3 axes), desc1 (3 axes), image_size0 (2 axes), "
    "image_size1 (2 axes), matches0 (1 axes), mscores0 (1 axes)",
}
_PROVIDERS: Mapping[Provider, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "directml": "DmlExecutionProvider",
}


@dataclass(frozen=True)
class Networks:
    """Where the networks are read from and what executes them."""

    # folder with one's own files, named as in `DIGESTS`, or with COLMAP's; None takes those of the package
    models: Path | None = None
    provider: Provider = "cpu"  # what ONNX Runtime executes them with

    def load(self, file: str) -> Network:
        """Return a network, loaded once per process.

        Raises:
            UsageError: if the file is missing or damaged, or the provider is not installed.
        """
        return open_network(self._path(file), self.provider)

    def of_colmap(self, part: Literal["extractor", "matcher"]) -> Network | None:
        """Return COLMAP's network for ALIKED or for LightGlue; None if the folder has none of COLMAP's files.

        Raises:
            UsageError: if the folder has only one of the two or several of a kind, if its descriptors are not 128
                numbers, a file is damaged, or the provider is not installed.
        """
        if self.models is None or any(is_file(self.models / file) for file in DIGESTS):
            return None
        loaded: dict[Path, Network] = {}
        unusable: list[UsageError] = []
        for path in children(self.models, "[!.]*.onnx"):
            try:
                loaded[path] = open_network(path, self.provider)
            except UsageError as error:  # of another program, perhaps
                unusable.append(error)
        found = {
            kind: [path for path, one in loaded.items() if ", ".join(one.interface) == interface]
            for kind, interface in _COLMAP.items()
        }
        if unusable and not all(found.values()):
            raise unusable[0]
        if not any(found.values()):
            return None
        for kind, paths in found.items():
            if len(paths) != 1:
                names = " and ".join(path.name for path in paths) or "none"
                raise UsageError(
                    f"{self.models}: needs one {kind} in COLMAP's form, but has {names}. Leave one of COLMAP's "
                    "aliked-n16rot.onnx and aliked-n32.onnx in the folder, with aliked-lightglue.onnx"
                )
        if (width := loaded[found["extractor"][0]].width_of("descriptors")) not in {128, None}:
            raise UsageError(
                f"{found['extractor'][0]}: descriptors must have 128 numbers, but have {width}. Take COLMAP's "
                "aliked-n16rot.onnx or aliked-n32.onnx"
            )
        return loaded[found[part][0]]

    def check(self) -> None:
        """Check all files and the provider, so that nothing is computed in vain.

        Raises:
            UsageError: if a file is missing, damaged or has other inputs or outputs than that of the package, or the
                provider is not installed.
        """
        if self.of_colmap("extractor"):
            return
        for file in DIGESTS:
            self._path(file)
            if self == PACKAGED:
                continue
            expected, found = PACKAGED.load(file).interface, self.load(file).interface
            if found != expected:
                raise UsageError(
                    f"{self.models}: {file} must have {', '.join(expected)}, but has {', '.join(found)}. "
                    "tools/export_networks.py writes such files"
                )

    def _path(self, file: str) -> Path:
        if self.models is None:
            digest = DIGESTS[file]
            if file == "lightglue_layer.onnx" and self.provider != "cpu":
                file, digest = _FLOAT_LAYER
            return _checked(_PACKAGED / file, digest)
        path = self.models / file
        if not is_file(path):
            own = [name for name in DIGESTS if is_file(self.models / name)]
            raise UsageError(
                f"{path}: this network is missing. tools/export_networks.py writes all files, or take "
                "aliked-n16rot.onnx and aliked-lightglue.onnx of COLMAP 4"
                + (f", in a folder without {' and '.join(own)}" if own else "")
            )
        return path


PACKAGED = Networks()


def open_network(path: Path, provider: Provider = "cpu") -> Network:
    """Return the network of an ONNX file, loaded once per process.

    Raises:
        UsageError: if the file is missing or damaged, or the provider is not installed.
    """
    if not is_file(path):
        raise UsageError(f"{path}: there is no such file. Give the path of a network in the ONNX format")
    return Network(_session(path, path.stat().st_mtime_ns, provider))


def packaged_network(path: Path, digest: str) -> Network:
    """Return the network of a file of the package, loaded once per process, after a check of its SHA-256 digest.

    Raises:
        UsageError: if the file is missing or damaged.
    """
    return open_network(_checked(path, digest))


class Network:
    """A network that is ready to run.

    It runs on one thread, since the engine computes as many units at once as there are cores, and its results do not
    depend on their number.
    """

    def __init__(self, session: Any) -> None:
        self._session = session

    @property
    def interface(self) -> list[str]:
        """The names and numbers of axes of the inputs and outputs."""
        ends = (*self._session.get_inputs(), *self._session.get_outputs())
        return [f"{one.name} ({len(one.shape)} axes)" for one in ends]

    def width_of(self, output: str) -> int | None:
        """Return the size of the last axis of an output; None if it is left open."""
        size = next(one.shape[-1] for one in self._session.get_outputs() if one.name == output)
        return size if isinstance(size, int) else None

    def picture_input(self) -> tuple[str, list[int | None]]:
        """Return the name and shape of the only input, a picture (1, 3, h, w); None for sizes that are left open.

        Raises:
            UsageError: if the network has other inputs.
        """
        inputs = self._session.get_inputs()
        shape = [size if isinstance(size, int) else None for size in inputs[0].shape]
        if len(inputs) != 1 or inputs[0].type != "tensor(float)" or len(shape) != 4 or shape[1] not in {3, None}:
            found = ", ".join(f"{one.name} {one.type} {one.shape}" for one in inputs)
            raise UsageError(f"the network must have one input of float32 (1, 3, height, width), but has {found}")
        return inputs[0].name, shape

    def __call__(self, **inputs: NDArray[np.generic]) -> list[Array]:
        """Return the outputs in their order."""
        outputs: list[Array] = self._session.run(None, inputs)
        return outputs


def _checked(path: Path, digest: str) -> Path:
    if not is_file(path):
        raise UsageError(f"{path}: this network is missing. Install pano-mvs again")
    if _digest(path, path.stat().st_mtime_ns) != digest:
        raise UsageError(f"{path}: this file of the package is damaged. Install pano-mvs again")
    return path


@lru_cache
def _digest(path: Path, _changed_ns: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@lru_cache
def _session(path: Path, _changed_ns: int, provider: Provider) -> Any:
    runtime = importlib.import_module("onnxruntime")  # takes a tenth of a second, which no other stage should pay
    available = runtime.get_available_providers()
    if _PROVIDERS[provider] not in available:
        usable = [name for name, theirs in _PROVIDERS.items() if theirs in available]
        raise UsageError(
            f"provider {provider!r} is not in the installed ONNX Runtime, which has {', '.join(usable)}. Install the "
            "package of ONNX Runtime that has it, or use provider: cpu"
        )
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # The last level of ONNX Runtime changes the layout of convolutions, and changes it back for every SELU of ALIKED.
    options.graph_optimization_level = (
        runtime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        if path.name == "aliked_detector.onnx"
        else runtime.GraphOptimizationLevel.ORT_ENABLE_ALL
    )
    options.enable_mem_pattern = False  # the numbers of key points change with each call: saves a fifth of the memory
    names = list(dict.fromkeys([_PROVIDERS[provider], _PROVIDERS["cpu"]]))
    try:
        return runtime.InferenceSession(path, options, providers=names)
    except Exception as error:  # its errors have no common base
        raise UsageError(f"{path}: ONNX Runtime cannot load this network, which may be damaged: {error}") from error
