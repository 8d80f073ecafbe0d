"""Try the compiled libraries, each in a process of its own: a crash of one does not end the others or the doctor."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeAlias

from pano_mvs.cli.doctor.finding import Finding, State

TIMEOUT_S = 180.0
Answer: TypeAlias = Mapping[str, Any] | str
"""The JSON object that a probe printed last, or, if it failed, the reason."""

_REINSTALL = "pip install --force-reinstall --no-deps"
_finding = partial(Finding, "libraries")

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
image = numpy.full((32, 64, 3), 100, numpy.uint8)
missing = []
for suffix, kind in ((".jpg", numpy.uint8), (".png", numpy.uint8), (".tiff", numpy.float32), (".webp", numpy.uint8)):
    good, data = cv2.imencode(suffix, image.astype(kind))
    if not good or cv2.imdecode(data, cv2.IMREAD_UNCHANGED) is None:
        missing.append(suffix.lstrip("."))
backends = [cv2.videoio_registry.getBackendName(number) for number in cv2.videoio_registry.getBackends()]
print(json.dumps({"version": cv2.__version__, "missing": missing, "video": "FFMPEG" in backends,
                  "avif": bool(cv2.haveImageWriter("a.avif"))}))
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


def library_findings(
    probe: Callable[[str], Answer] | None = None, *, has_torch_plugin: bool | None = None
) -> Iterator[Finding]:
    """Yield how the compiled libraries work.

    Args:
        probe: runs the code of a probe; `run_probe` by default.
        has_torch_plugin: whether the sweep on PyTorch is installed; looked up by default.
    """
    if has_torch_plugin is None:
        has_torch_plugin = importlib.util.find_spec("pano_mvs_torch") is not None
    libraries = [library for library in _LIBRARIES if library.name != "torch" or has_torch_plugin]
    with ThreadPoolExecutor(2) as pool:
        answers = list(pool.map(probe or run_probe, (library.code for library in libraries)))
    for library, answer in zip(libraries, answers, strict=True):
        if isinstance(answer, str):
            yield _finding(library.name, library.state_if_broken, f"{answer}{library.consequence}", library.remedy)
        else:
            yield from library.findings(answer)
    if not has_torch_plugin:
        detail = "the sweep on PyTorch (for graphics cards) is not installed; it is optional"
        yield _finding("torch", "note", detail, "pip install ./plugins/pano_mvs_torch in a checkout")


def _of_numba(answer: Mapping[str, Any]) -> Iterator[Finding]:
    if answer["disabled"]:
        yield _finding("numba", "warning", "compiles nothing: hundreds of times slower", "unset NUMBA_DISABLE_JIT")
    else:
        yield _finding("numba", "ok", f"{answer['version']}, compiles")


def _of_pycolmap(answer: Mapping[str, Any]) -> Iterator[Finding]:
    yield _finding("pycolmap", "ok", f"{answer['version']}, has EQUIRECTANGULAR cameras")


def _of_opencv(answer: Mapping[str, Any]) -> Iterator[Finding]:
    reinstall = f"{_REINSTALL} opencv-python-headless"
    if answer["missing"]:
        yield _finding("OpenCV", "failed", f"{answer['version']} lacks {', '.join(answer['missing'])}", reinstall)
    else:
        video, avif = ("yes" if answer[what] else "no" for what in ("video", "avif"))
        yield _finding("OpenCV", "ok", f"{answer['version']}: JPEG, PNG, TIFF, WebP; AVIF: {avif}, video: {video}")
    if not answer["video"]:
        yield _finding("OpenCV video", "warning", "reads no videos (no FFmpeg)", reinstall)
    if not answer["avif"]:
        yield _finding("OpenCV AVIF", "note", "reads no AVIF images", "pip install -U opencv-python-headless")


def _of_pyvista(answer: Mapping[str, Any]) -> Iterator[Finding]:
    yield _finding("PyVista", "ok", f"{answer['version']}, renders without a screen")


def _of_torch(answer: Mapping[str, Any]) -> Iterator[Finding]:
    if answer["devices"]:
        yield _finding("torch", "ok", f"{answer['version']}: {'; '.join(answer['devices'])}")
        return
    build = "built without CUDA" if answer["built_for"] is None else f"built for CUDA {answer['built_for']}"
    detail = f"{answer['version']}, {build}, finds no graphics card: backend torch uses the CPU"
    yield _finding("torch", "note", detail, "install the card's driver and a build of torch with CUDA")


class _Library(NamedTuple):
    """A library, the code that tries it, how to read its answer, and what a failure means."""

    name: str
    code: str
    findings: Callable[[Mapping[str, Any]], Iterator[Finding]]
    state_if_broken: State
    remedy: str
    consequence: str = ""


_OPENGL = "install the system's OpenGL libraries (Debian, Ubuntu: apt install libgl1 libegl1), or pip install -U vtk"
_LIBRARIES = (
    _Library("numba", _NUMBA, _of_numba, "failed", f"{_REINSTALL} numba llvmlite"),
    _Library("pycolmap", _PYCOLMAP, _of_pycolmap, "failed", f"{_REINSTALL} pycolmap"),
    _Library("OpenCV", _OPENCV, _of_opencv, "failed", f"{_REINSTALL} opencv-python-headless"),
    _Library("PyVista", _PYVISTA, _of_pyvista, "warning", _OPENGL, ": there are no pictures of clouds; all else works"),
    _Library("torch", _TORCH, _of_torch, "warning", "reinstall torch, or sweep with `backend: numba`"),
)
