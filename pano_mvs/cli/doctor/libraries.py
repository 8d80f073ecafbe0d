"""Try the compiled libraries, each in a process of its own: a crash of one does not end the others or the doctor."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeAlias

from pano_mvs.cli.doctor.checks import Finding, State

TIMEOUT_S = 180.0
Answer: TypeAlias = Mapping[str, Any] | str
"""The JSON object that a probe printed last, or, if it failed, the reason."""

_REINSTALL = "pip install --force-reinstall --no-deps"
_NUMBA = """
import json
import numba, numpy
@numba.njit(error_model="numpy", nogil=True)
def total(values):
    found = 0.0
    for value in values:
        found += value
    return found
assert total(numpy.arange(10.0)) == 45
print(json.dumps({"version": numba.__version__, "disabled": bool(numba.config.DISABLE_JIT)}))
"""

_PYCOLMAP = """
import json
import numpy, pycolmap
camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=200, height=100, params=[200, 100])
pixel = camera.img_from_cam(numpy.array([[0.0, 0.0, 1.0]]))
assert abs(pixel - [[100, 50]]).max() < 1e-6, pixel
pycolmap.Reconstruction().add_camera_with_trivial_rig(camera)
print(json.dumps({"version": pycolmap.__version__}))
"""

_OPENCV = """
import json
import cv2, numpy
good, data = cv2.imencode(".jpg", numpy.full((32, 64, 3), 100, numpy.uint8))
assert good and cv2.imdecode(data, cv2.IMREAD_UNCHANGED) is not None
backends = [cv2.videoio_registry.getBackendName(number) for number in cv2.videoio_registry.getBackends()]
print(json.dumps({"version": cv2.__version__, "video": "FFMPEG" in backends,
                  "avif": bool(cv2.haveImageWriter("a.avif"))}))
"""

_ONNX_RUNTIME = """
import json
import onnxruntime
from pano_mvs.algorithms.learned.networks import PACKAGED
PACKAGED.load("lightglue_start.onnx")
print(json.dumps({"version": onnxruntime.__version__}))
"""

_PYVISTA = """
import json
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.set_background("black")
plotter.add_mesh(pyvista.Sphere(), color="white")
image = plotter.screenshot(return_img=True)
plotter.close()
assert image.max() > 100, "the image is black"
print(json.dumps({"version": pyvista.__version__}))
"""

_TORCH = """
import json
import torch
count = torch.cuda.device_count() if torch.cuda.is_available() else 0
names = [f"{torch.cuda.get_device_name(k)}, {torch.cuda.get_device_properties(k).total_memory / 1e9:.0f} GB"
         for k in range(count)]
if count:
    assert float(torch.ones(8, device="cuda").sum()) == 8
print(json.dumps({"version": torch.__version__, "devices": names, "built_for": torch.version.cuda}))
"""


def run_probe(code: str, *, timeout_s: float = TIMEOUT_S) -> Answer:
    """Run code, whose last printed line is a JSON object, in a process of its own."""
    command = [sys.executable, "-P", "-c", code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)  # noqa: S603
    except subprocess.TimeoutExpired:
        return f"gave no answer within {timeout_s:.0f} s"
    except OSError as error:
        return f"could not be tried: {error}"
    lines = done.stdout.strip().splitlines()
    if done.returncode == 0 and lines:
        answer: dict[str, Any] = json.loads(lines[-1])
        return answer
    if done.returncode < 0:
        return f"the process died of signal {-done.returncode}"
    return (done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"])[-1]


def library_findings() -> Iterator[Finding]:
    """Yield how the compiled libraries work."""
    has_torch_plugin = importlib.util.find_spec("pano_mvs_torch") is not None
    libraries = [library for library in _LIBRARIES if library.name != "torch" or has_torch_plugin]
    with ThreadPoolExecutor(2) as pool:
        answers = list(pool.map(run_probe, (library.code for library in libraries)))
    for library, answer in zip(libraries, answers, strict=True):
        yield from findings_of(library, answer)
    if not has_torch_plugin:
        detail = "the sweep on PyTorch (for graphics cards) is not installed; it is optional"
        yield Finding("libraries", "torch", "note", detail, "pip install ./plugins/pano_mvs_torch in a checkout")


def findings_of(library: Library, answer: Answer) -> Iterator[Finding]:
    """Yield what the answer of a probe means."""
    if isinstance(answer, str):
        yield Finding(
            "libraries", library.name, library.state_if_broken, f"{answer}{library.consequence}", library.remedy
        )
        return
    if library.name == "numba" and answer["disabled"]:
        yield Finding(
            "libraries", "numba", "warning", "compiles nothing: hundreds of times slower", "unset NUMBA_DISABLE_JIT"
        )
        return
    if library.name == "torch":
        yield _of_torch(answer)
        return
    yield Finding("libraries", library.name, "ok", f"{answer['version']}, {library.success}")
    if not answer.get("video", True):
        yield Finding("libraries", "OpenCV video", "warning", "reads no videos (no FFmpeg)", library.remedy)
    if not answer.get("avif", True):
        yield Finding(
            "libraries", "OpenCV AVIF", "note", "reads no AVIF images", "pip install -U opencv-python-headless"
        )


def _of_torch(answer: Mapping[str, Any]) -> Finding:
    if answer["devices"]:
        return Finding("libraries", "torch", "ok", f"{answer['version']}: {'; '.join(answer['devices'])}")
    build = "built without CUDA" if answer["built_for"] is None else f"built for CUDA {answer['built_for']}"
    detail = f"{answer['version']}, {build}, finds no graphics card: backend torch uses the CPU"
    return Finding("libraries", "torch", "note", detail, "install the card's driver and a build of torch with CUDA")


class Library(NamedTuple):
    """A library, the code that tries it, what works if it succeeds, and what a failure means."""

    name: str
    code: str
    success: str
    state_if_broken: State
    remedy: str
    consequence: str = ""


_OPENGL = "install the system's OpenGL libraries (Debian, Ubuntu: apt install libgl1 libegl1), or pip install -U vtk"
_NO_VIEWER = ": `pano-mvs view` cannot draw; all else works"
_LIBRARIES = (
    Library("numba", _NUMBA, "compiles", "failed", f"{_REINSTALL} numba llvmlite"),
    Library("pycolmap", _PYCOLMAP, "has EQUIRECTANGULAR cameras", "failed", f"{_REINSTALL} pycolmap"),
    Library("OpenCV", _OPENCV, "reads images", "failed", f"{_REINSTALL} opencv-python-headless"),
    Library("ONNX Runtime", _ONNX_RUNTIME, "runs networks", "failed", f"{_REINSTALL} onnxruntime"),
    Library("PyVista", _PYVISTA, "renders without a screen", "warning", _OPENGL, _NO_VIEWER),
    Library("torch", _TORCH, "", "warning", "reinstall torch, or sweep with `backend: numba`"),
)
